"""Time offsets in the graph of the tracker: from sums of frames, place by place."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.graph.by_place import LateQuadraticByPlace
from calibgraph.graph.lens import LensTerm
from calibgraph.graph.variables import seen_lens_key
from calibgraph.model.findings import MatcherFindings
from calibgraph.solver.lens import lens_term_of
from calibgraph.solver.within_place import WithinPlace
from calibgraph.tracking.state import State
from calibgraph.tracking.sums import Sums

Numbers = NDArray[np.int64]


def offset_term(state: State, camera: int, sums: Sums, within: WithinPlace) -> LensTerm:
    """The offset of a camera in the error model; scan distortion does not displace it.

    Args:
        state: of the tracker.
        camera: by its place in the rig.
        sums: (p,) of the camera at each place where it has frames.
        within: what its matches of one of these places share.
    """
    assert state.offsets is not None
    lens = state.offsets.variable(state.rig, camera)
    units, total = _units(lens.free.sigmas[0]), sums.total()
    findings: MatcherFindings = state.findings
    of_poses = within.at_place(findings.place_variance)
    shown = units @ sums.reweighted @ units, units @ total.scatter @ units, of_poses
    counts = float(total.matches), float(total.frames)
    term = lens_term_of(lens, shown, counts, within, findings=findings)
    bends = len(findings.bend_sigmas)
    return LensTerm(lens, term.excess, np.zeros((1, bends)), term.compensating)


def late_quadratic(
    state: State,
    camera: int,
    places: Numbers,
    chosen: Sequence[tuple[gtsam.Pose3, float, Array]],
) -> LateQuadraticByPlace:
    """The matches of a camera, by T_lidar_camera, offset [s] and (7, 7) information at places."""
    assert state.offsets is not None
    lens = state.offsets.variable(state.rig, camera)
    sigma = lens.free.sigmas[0]
    units = _units(sigma)
    away_s = np.array([offset for _, offset, _ in chosen]) - lens.free.clock.offset_s
    information = np.array([units @ one @ units for _, _, one in chosen]).reshape(-1, 7, 7)
    poses = [pose for pose, _, _ in chosen]
    key = seen_lens_key(camera)
    return LateQuadraticByPlace(places, poses, away_s / sigma, information, key)


def _units(sigma_s: float) -> Array:
    """(7, 7) from the units of the variable to seconds."""
    return np.diag(np.append(np.ones(6), sigma_s))
