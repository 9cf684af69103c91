"""Frames of a camera whose matches are gated, and their sums."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.model.geometry import to_T_camera_lidar
from calibgraph.solver.covariance import robust_hessians
from calibgraph.solver.matches import MIN_MATCHES, BlockResiduals, CameraBlock
from calibgraph.solver.robust import ResidualScale
from calibgraph.tracking.sums import Sums, step_between


@dataclass(frozen=True, eq=False)
class Gated:
    """Matches of a camera, gated at one T_lidar_camera.

    Attributes:
        residuals: of all of them, there.
        inliers: (m,) which of them are within the gate.
        sums: (f,) of these, frame by frame; none of a frame with too few.
    """

    residuals: BlockResiduals
    inliers: NDArray[np.bool_]
    sums: Sums

    def of_frame(self, row: int) -> tuple[CameraBlock, NDArray[np.bool_]]:
        """A frame's matches, and which of them are within the gate."""
        raw = self.residuals.block
        if raw.frames == 1:
            return raw, self.inliers
        first, end = raw.frame_edges[row : row + 2]
        return raw.select(np.arange(first, end)), self.inliers[first:end]

    @staticmethod
    def at(
        T_lidar_camera: gtsam.Pose3,
        raw: CameraBlock,
        scale: ResidualScale,
        reference: gtsam.Pose3,
        *,
        edges: NDArray[np.int64] | None = None,
    ) -> Gated:
        """The matches near the minimum.

        Args:
            T_lidar_camera: where they are linearized.
            raw: all of them.
            scale: of the residuals.
            reference: T_lidar_camera at which the gradient is taken.
            edges: (f + 1,) of what counts as a frame; None: the frames.
        """
        residuals, edges = (
            BlockResiduals.at(to_T_camera_lidar(T_lidar_camera), raw),
            raw.frame_edges if edges is None else edges,
        )
        inliers = residuals.inliers(scale)
        counts = np.add.reduceat(inliers, edges[:-1], dtype=np.int64)
        enough = counts >= MIN_MATCHES
        inside = np.concatenate([[0], counts.cumsum()])
        pose = residuals.T_lidar_camera
        block = raw.select(inliers).with_scale(scale)
        here = block.frame_sums(pose, inside, curvature=True)
        hessian = robust_hessians(here) + residuals.gate_hessians(scale, edges)
        score = here.gradient
        sums = Sums.of(
            hessian=hessian,
            gradient=score + hessian @ step_between(pose, reference),
            reweighted=here.hessian,
            score=score,
            scatter=score[:, :, None] * score[:, None, :],
            frames=np.ones(len(counts)),
            matches=counts.astype(np.float64),
        )
        return Gated(residuals, inliers, sums if enough.all() else sums * enough.astype(np.float64))
