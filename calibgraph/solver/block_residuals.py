"""The residuals of one camera's correspondences at an extrinsic, and what the gate does to them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.calibration import Residuals
from calibgraph.model.geometry import to_T_lidar_camera
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.residual_scale import ResidualScale, quantile, robust_spread
from calibgraph.solver.whitening import (
    constrained_error_px,
    error_gradient,
    median_norm,
    whitened_norm,
)

_GATE_BAND = 0.1  # relative half width of the band about the gate whose density is measured


@dataclass(frozen=True, eq=False)
class BlockResiduals:
    """The residuals of a block at one extrinsic, evaluated once.

    Attributes:
        block: the correspondences.
        T_lidar_camera: where.
        residuals_px: (n, 2) predicted minus observed pixel, unweighted.
        projectable: (n,) whether the point is in front of the camera and inside the lens' domain.
    """

    block: CameraBlock
    T_lidar_camera: gtsam.Pose3
    residuals_px: Array
    projectable: NDArray[np.bool_]

    @classmethod
    def at(cls, T_camera_lidar: Array, block: CameraBlock) -> BlockResiduals:
        """Those of a block at a (4, 4) T_camera_lidar."""
        T_lidar_camera = to_T_lidar_camera(T_camera_lidar)
        return cls(block, T_lidar_camera, *block.block.residuals(T_lidar_camera))

    @cached_property
    def errors_px(self) -> Array:
        """(n,) unweighted errors [px], along the directions that each match constrains."""
        return constrained_error_px(self.residuals_px, self.block.information)

    @cached_property
    def sizes(self) -> tuple[Array, Array]:
        """As :meth:`CameraBlock.all_sizes`, of the projectable points alone."""
        medians = median_norm(self.block.information)
        medians = medians[self.projectable] if medians.ndim else medians
        sizes_px = self.errors_px[self.projectable] / medians
        root = self.block.block.sqrt_information
        if self.block.information is None and root is None:
            return sizes_px, sizes_px
        return sizes_px, whitened_norm(root, self.residuals_px)[self.projectable] / medians

    def inliers(self, scale: ResidualScale) -> NDArray[np.bool_]:
        """(n,) which lie within the gate, in front of the camera."""
        return np.asarray(self.projectable & (self.errors_px <= scale.gate_px))

    def gate_hessians(self, scale: ResidualScale, edges: NDArray[np.int64] | None = None) -> Array:
        """(r, 6, 6) what the gate's moving with the extrinsic adds to the Hessian of the inliers.

        A step of the extrinsic takes matches over the edge of the gate, out on one side and in on
        the other, and their gradients with them. The term is some percent of the Hessian, and
        negative. It is measured on the matches near the edge, on both sides of it.

        Args:
            scale: with the gate.
            edges: (r + 1,) of the runs of matches; None: all are one.
        """
        edges = np.array([0, len(self.errors_px)]) if edges is None else edges
        near = np.abs(self.errors_px - scale.gate_px) < _GATE_BAND * scale.gate_px
        band = np.flatnonzero(self.projectable & near)
        edge = self.block.select(band)
        residuals, errors = self.residuals_px[band], self.errors_px[band]
        across = error_gradient(residuals, errors, edge.information)
        across *= (whitened_norm(edge.block.sqrt_information, residuals) / errors)[:, None]
        root = np.column_stack([across, np.zeros(len(across))])
        weighted = replace(edge, block=edge.block.rewhiten(root))
        of_run = np.searchsorted(band, edges)
        sums = weighted.with_scale(scale).frame_sums(self.T_lidar_camera, of_run)
        return np.asarray(-sums.hessian / (2 * _GATE_BAND))

    def summary(self, scale: ResidualScale) -> Residuals:
        """What the result reports of them."""
        return Residuals(
            median_px=quantile(self.errors_px, 0.5),
            inlier_share=float(np.mean(self.inliers(scale))),
            sigma_px=robust_spread(self.sizes[0]),
            loss_scale_px=scale.loss_scale,
            gate_px=scale.gate_px,
        )
