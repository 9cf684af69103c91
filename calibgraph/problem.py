"""The optimization problem: matches and what is known of poses, and its minimum."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.config import Terms
from calibgraph.graph import Optimum, joined, optimize, projection_graph
from calibgraph.matches import Matches, Scale

Array = NDArray[np.float64]
Poses = dict[str, Array]
Scales = dict[str, Scale]


@dataclass(frozen=True, eq=False)
class Problem:
    """What the objective is made of (paper, Eq. 5).

    Attributes:
        cameras: all cameras of the rig, in its order.
        matches: per camera that has enough correspondences.
        pose_graph: the priors and the relative poses.
        terms: which of them are used.
        gate_hessian: of gated matches, see ``Matches.gate_hessian``; empty before the gate.
    """

    cameras: tuple[str, ...]
    matches: dict[str, Matches]
    pose_graph: gtsam.NonlinearFactorGraph
    terms: Terms
    gate_hessian: Mapping[str, Array] = field(default_factory=dict)

    @property
    def fits_matches(self) -> bool:
        """Whether the terms have a reprojection term."""
        return self.terms in ("full", "reprojection")

    def with_matches(self, matches: Mapping[str, Matches]) -> Problem:
        """The same problem with other (fewer) correspondences."""
        return replace(self, matches=dict(matches))

    def minimize(self, start: Poses, scales: Scales) -> Optimum:
        """The minimum by Levenberg-Marquardt, with the residuals' scales held."""
        if self.terms == "stage1":
            return Optimum(start, math.nan, 0, True)
        graph = self.pose_graph
        if self.fits_matches:
            blocks = {name: m.scaled(scales[name]) for name, m in self.matches.items()}
            graph = joined(projection_graph(self.cameras, blocks), graph)
        return optimize(graph, self.cameras, start)
