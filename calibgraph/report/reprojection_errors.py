"""The reprojection errors of each camera's correspondences, at the result."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.calibration import Calibration
from calibgraph.model.geometry import to_T_lidar_camera
from calibgraph.solver.matches import CameraBlock, camera_blocks
from calibgraph.solver.preprocess import preprocess


@dataclass(frozen=True, eq=False)
class ReprojectionErrors:
    """The errors of one camera's preprocessed correspondences.

    Attributes:
        points_lidar_m: (n, 3) in the LiDAR frame.
        pixels_px: (n, 2) matched pixels.
        vectors_px: (n, 2) projected less matched, along the directions that the match constrains:
            for an edge, across it. The gate compares its length.
        distances_m: (n,) from the camera to the points.
        frame: (n,) frame numbers.
        gate_px: tau of the result.
    """

    points_lidar_m: Array
    pixels_px: Array
    vectors_px: Array
    distances_m: Array
    frame: NDArray[np.int64]
    gate_px: float

    @property
    def sizes_px(self) -> Array:
        """(n,) lengths of ``vectors_px``."""
        return np.asarray(np.hypot(*self.vectors_px.T))

    @property
    def is_inlier(self) -> NDArray[np.bool_]:
        """(n,) whether the error is within the gate."""
        return np.asarray(self.sizes_px <= self.gate_px)

    def select(self, rows: NDArray[np.bool_]) -> ReprojectionErrors:
        """The errors of some correspondences."""
        columns: dict[str, Any] = {
            name: column[rows]
            for name, column in vars(self).items()
            if isinstance(column, np.ndarray)
        }
        return replace(self, **columns)


def reprojection_errors(result: Calibration) -> dict[str, ReprojectionErrors]:
    """The errors of each camera with correspondences; empty without a table.

    Raises:
        CorrespondenceError: if the table does not belong to the result's rig.
    """
    if result.correspondences is None:
        return {}
    # The last of several rounds of matching started near the result, not at the guess.
    start = result.rig if len(result.rounds) > 1 else result.initial_rig
    table = preprocess(start, result.correspondences, result.config).table
    blocks = camera_blocks(result.rig, table, result.config)
    return {
        name: _errors_at(result.T_camera_lidar[name], blocks[name], measured.gate_px)
        for name, measured in result.residuals.items()
        if name in blocks
    }


def _errors_at(T_camera_lidar: Array, matches: CameraBlock, gate_px: float) -> ReprojectionErrors:
    """The errors of those matches that project into the camera at this extrinsic."""
    block = matches.block
    residuals, valid = block.residuals(to_T_lidar_camera(T_camera_lidar))
    points_camera = block.points_lidar_m @ T_camera_lidar[:3, :3].T + T_camera_lidar[:3, 3]
    everything = ReprojectionErrors(
        points_lidar_m=block.points_lidar_m,
        pixels_px=block.pixels_px,
        vectors_px=constrained(residuals, matches.information),
        distances_m=np.linalg.norm(points_camera, axis=1),
        frame=matches.frame,
        gate_px=gate_px,
    )
    return everything.select(valid)


def constrained(residuals: Array, information: Array | None) -> Array:
    """(n, 2) I^(1/2) r / lambda_max^(1/2); its length is ``whitening.constrained_error_px``.

    The root of a 2x2 matrix I is (I + sqrt(det I) E) / sqrt(tr I + 2 sqrt(det I)).
    """
    if information is None:
        return residuals
    uu, uv, vv = information.T
    largest = (uu + vv) / 2 + np.hypot((uu - vv) / 2, uv)
    root = np.sqrt(np.maximum(uu * vv - uv**2, 0.0))
    scale = np.sqrt((uu + vv + 2 * root) * largest)
    x, y = residuals.T
    rooted = np.column_stack([(uu + root) * x + uv * y, uv * x + (vv + root) * y])
    return np.asarray(rooted / scale[:, None])
