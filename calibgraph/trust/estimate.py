"""One camera's estimate, from a batch solve or while driving, as checks need it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.config import Terms
from calibgraph.model.lens_estimate import LensEstimate
from calibgraph.model.rig import Camera
from calibgraph.model.verdict import TOLERANCE
from calibgraph.solver.conflicts import Conflict


@dataclass(frozen=True, eq=False)
class Estimate:
    """One camera's estimate and the values that its checks need.

    Attributes:
        camera: lens, and the initial guess.
        has_matches: whether it had correspondences; else it was solved through relative poses.
        used: correspondences in the final solve.
        frames: frames that they come from.
        covariance: (6, 6) of (rotation [rad], translation [m]), or None.
        data_sigmas: (6,) standard deviations if every correspondence were independent: rotation
            [rad], translation [m]; or None.
        conflicts: of the relative poses that name this camera.
        converged: whether the last pass stopped by its tolerance.
        terms: of the objective.
        held: whether nothing determines it.
        excluded: whether the settings exclude its correspondences.
        scatter_only: whether it is unknown how large the error is that all frames share.
        tolerance: of the user: rotation [deg] and distance [cm].
        lens: the parameters of lens and clock that were estimated.
    """

    camera: Camera
    has_matches: bool
    used: int
    frames: int
    covariance: Array | None
    data_sigmas: Array | None
    conflicts: tuple[Conflict, ...]
    converged: bool
    terms: Terms
    held: bool = False
    excluded: bool = False
    scatter_only: bool = False
    tolerance: tuple[float, float] = TOLERANCE
    lens: tuple[LensEstimate, ...] = ()

    @property
    def sigmas(self) -> Array | None:
        """(6,) standard deviations: rotation [rad], translation [m]; or None."""
        return None if self.covariance is None else np.sqrt(np.diag(self.covariance))
