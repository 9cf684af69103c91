"""What the pictures are drawn from: the residuals of each camera, and the frame that is shown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import DatasetError
from calibgraph.io.dataset import Dataset
from calibgraph.model.calibration import Calibration
from calibgraph.model.geometry import to_T_lidar_camera
from calibgraph.solver.camera_block import CameraBlock, camera_blocks
from calibgraph.solver.preprocess import preprocess

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Errors:
    """The errors of one camera's preprocessed correspondences at one pose.

    Attributes:
        points_lidar_m: (n, 3) in the LiDAR frame.
        pixels_px: (n, 2) matched pixels.
        projected_px: (n, 2) where the points project to.
        vectors_px: (n, 2) projected less matched, along the directions that the match constrains:
            of an edge, the way from it. Its length is what the gate looks at.
        distances_m: (n,) of the points from the camera.
        frame: (n,) frame numbers.
        gate_px: of the result.
    """

    points_lidar_m: Array
    pixels_px: Array
    projected_px: Array
    vectors_px: Array
    distances_m: Array
    frame: NDArray[np.int64]
    gate_px: float

    @property
    def sizes_px(self) -> Array:
        """(n,) lengths of ``vectors_px``."""
        return np.asarray(np.hypot(*self.vectors_px.T))

    @property
    def inside(self) -> NDArray[np.bool_]:
        """(n,) which are inside the gate."""
        return np.asarray(self.sizes_px <= self.gate_px)

    def select(self, rows: NDArray[np.bool_]) -> Errors:
        """Only some of them."""
        columns: dict[str, Any] = {
            name: column[rows]
            for name, column in vars(self).items()
            if isinstance(column, np.ndarray)
        }
        return replace(self, **columns)


@dataclass(frozen=True, eq=False)
class BeforeAfter:
    """The errors of one camera at the guess and at the result, of the same correspondences."""

    before: Errors
    after: Errors


def errors_of(result: Calibration) -> dict[str, BeforeAfter]:
    """Per camera with correspondences, their errors before and after; empty without a table.

    Raises:
        CorrespondenceError: if the table does not belong to the result's rig.
    """
    if result.correspondences is None:
        return {}
    # The last of several rounds of matching started near the result, not at the guess.
    start = result.rig if len(result.rounds) > 1 else result.initial_rig
    table = preprocess(start, result.correspondences, result.config).table
    matches = camera_blocks(start, table, result.config)
    return {
        name: BeforeAfter(
            _errors(m, result.initial_rig.T_camera_lidar[name], result.residuals[name].gate_px),
            _errors(m, result.T_camera_lidar[name], result.residuals[name].gate_px),
        )
        for name, m in matches.items()
        if name in result.residuals
    }


def _errors(matches: CameraBlock, T_camera_lidar: Array, gate_px: float) -> Errors:
    """The errors of the matches that project at a pose."""
    block = matches.block
    residuals, valid = block.residuals(to_T_lidar_camera(T_camera_lidar))
    points_camera = block.points_lidar_m @ T_camera_lidar[:3, :3].T + T_camera_lidar[:3, 3]
    everything = Errors(
        points_lidar_m=block.points_lidar_m,
        pixels_px=block.pixels_px,
        projected_px=block.pixels_px + residuals,
        vectors_px=_constrained(residuals, matches.information),
        distances_m=np.linalg.norm(points_camera, axis=1),
        frame=matches.frame,
        gate_px=gate_px,
    )
    return everything.select(valid)


def _constrained(residuals: Array, information: Array | None) -> Array:
    """(n, 2) I^(1/2) r / lambda_max^(1/2): as long as ``whitening.constrained_error_px``.

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


def shown_frame(result: Calibration) -> Mapping[str, Any] | None:
    """The frame whose images are shown: the middle one; None if the result names none."""
    return result.frames[len(result.frames) // 2] if result.frames else None


def with_files_of(result: Calibration, dataset: Dataset) -> Calibration:
    """The result, with its images and clouds read from a dataset that has moved.

    Args:
        result: of ``calibrate``, or of a table whose frame numbers are those of the dataset.
        dataset: the same folders in the same order.

    Raises:
        DatasetError: if the dataset does not have the result's frames.
    """
    known = {frame.index: frame for frame in dataset.frames}
    wanted = {entry["frame"]: entry["name"] for entry in result.frames}
    if not wanted and result.correspondences is not None:
        wanted = dict.fromkeys(np.unique(result.correspondences.frame).tolist())
    for number, name in wanted.items():
        if number not in known or name not in (None, known[number].name):
            raise DatasetError(
                f"{', '.join(map(str, dataset.folders))}: has no frame number {number}"
                f"{'' if name is None else f' named {name!r}'}, which the result was made from; "
                "give the same folders in the same order",
                frame=number,
            )
    return replace(result, frames=tuple(known[number].entry() for number in wanted))
