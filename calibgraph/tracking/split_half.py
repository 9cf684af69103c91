"""The estimates of every other epoch, which a check compares with each other."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.geometry import to_T_camera_lidar
from calibgraph.tracking.live_frames import LiveFrame
from calibgraph.tracking.posterior import is_determined
from calibgraph.tracking.state import State

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SplitHalf:
    """Sums of every other epoch, per camera, about the references.

    Attributes:
        hessian: (n, 2, 6, 6).
        gradient: (n, 2, 6).
        next_half: (n,) which of the two the next epoch is added to.
    """

    hessian: Array
    gradient: Array
    next_half: NDArray[np.int64]

    @staticmethod
    def of_closed_epochs(state: State) -> SplitHalf:
        """The sums without the open epoch."""
        summaries = [camera.summary for camera in state.cameras]
        halves = SplitHalf(
            np.array([summary.halves_hessian for summary in summaries]),
            np.array([summary.halves_gradient for summary in summaries]),
            np.array([summary.next_half for summary in summaries], dtype=np.int64),
        )
        for epoch in state.epochs[:-1]:
            halves = halves.add(epoch.frames)
        return halves

    def add(self, frames: Iterable[LiveFrame]) -> SplitHalf:
        """The sums with an epoch's frames added."""
        hessian, gradient = self.hessian.copy(), self.gradient.copy()
        cameras = np.arange(len(self.next_half))
        for frame in frames:
            hessian[cameras, self.next_half] += frame.hessian
            gradient[cameras, self.next_half] += frame.gradient
        return SplitHalf(hessian, gradient, 1 - self.next_half)

    def estimates(self, state: State, camera: int) -> tuple[Array, Array] | None:
        """Two (4, 4) T_camera_lidar of a camera; None if one of them is undetermined."""
        hessian, gradient = self.hessian[camera], self.gradient[camera]
        if not all(map(is_determined, hessian)):
            return None
        steps = np.linalg.solve(hessian, -gradient[..., None])[..., 0]
        first, second = (
            to_T_camera_lidar(state.references[camera].retract(step)) for step in steps
        )
        return first, second
