"""CameraInfo messages as lenses, of the images as recorded or of rectified ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calibgraph.arrays import Array
from calibgraph.files import checked_model
from calibgraph.io.bags.messages import describe_message
from calibgraph.io.lenses import (
    CameraLens,
    fitted_coefficients,
    intrinsics_of_matrix,
    lens_model,
    listed_intrinsics,
)
from calibgraph.model.geometry import transform
from calibgraph.model.rig import Camera
from factors import LensModel

_AS_NONE = ("", "inverse_brown_conrady")
"""Models of drivers that state zeros for an image without distortion."""
_SAME = 1e-6
_SAME_SHARE = 2e-3
"""Of the focal length, and of distortion, rotation and baseline: the error of a calibration."""


@dataclass(frozen=True)
class StatedLens:
    """A lens, as a CameraInfo describes it.

    Attributes:
        frame: the frame of the camera, z forward and y down, as the message names it.
        R_image_frame: (3, 3) from the frame to the axes of the image, which rectification turns.
        baseline_m: (3,) by P's fourth column, the origin of the first camera's frame in the axes of
            this image; zero for a camera that is no second one of a pair.
    """

    frame: str
    lens: CameraLens
    R_image_frame: Array
    baseline_m: Array

    def T_image_frame(self, *, with_baseline: bool) -> Array:
        """(4, 4) from the frame to the image; with the baseline where the frame is the first's."""
        return transform(self.R_image_frame, self.baseline_m if with_baseline else np.zeros(3))

    def agrees(self, other: StatedLens) -> bool:
        """Whether it is the same but for what a calibration leaves open: some drivers jitter."""
        fx = self.lens.intrinsics_px.fx
        one, two = (
            np.hstack([
                np.array([*each.lens.intrinsics_px.model_dump().values()]) / fx,
                [*each.lens.distortion, *[0.0] * 8][:8], each.R_image_frame.ravel(),
                each.baseline_m,
            ])
            for each in (self, other)
        )  # fmt: skip
        said = [(each.frame, each.lens.model, each.lens.size_px) for each in (self, other)]
        return said[0] == said[1] and bool(np.abs(one - two).max() < _SAME_SHARE)

    @property
    def is_turned(self) -> bool:
        """Whether the axes of the image and of the frame differ."""
        return bool(np.abs(self.R_image_frame - np.eye(3)).max() > _SAME)


def lens_of(message: Any, where: str, *, rectified: bool) -> StatedLens:
    """The lens of a camera's images as recorded, or as rectified by R to the matrix P."""
    frame = message.header.frame_id.lstrip("/")
    matrix = "P" if rectified else "K"
    K = np.reshape(_field(message, matrix), (3, -1))[:, :3]
    intrinsics_of_matrix(K, f"{where}: {matrix}")
    model: LensModel = "pinhole"
    distortion: tuple[float, ...] = ()
    if not rectified:
        given, stated = _field(message, "D"), message.distortion_model.strip()
        model = lens_model("none" if stated in _AS_NONE and not given.any() else stated, where)
        distortion = fitted_coefficients(given.tolist(), model, where)
    # K is of the full sensor, before its window and binning
    bins, window = np.maximum([message.binning_x, message.binning_y], 1), message.roi
    size = np.array([window.width or message.width, window.height or message.height]) // bins
    centre = (K[:2, 2] - np.array([window.x_offset, window.y_offset])) / bins
    numbers = [*(np.diag(K)[:2] / bins).tolist(), *centre.tolist()]
    intrinsics = listed_intrinsics(numbers, where)
    lens = CameraLens(model, (int(size[0]), int(size[1])), intrinsics, distortion)
    R = np.reshape(_field(message, "R"), (3, 3))
    R = R if R.any() else np.eye(3)
    baseline_m = stated_baseline(message)
    if rectified:
        return StatedLens(frame, lens, R, baseline_m)
    return StatedLens(frame, lens, np.eye(3), R.T @ baseline_m)


def camera_from_message(
    message: Any, T_camera_lidar: Array, *, rectified: bool = False, frame_of_first: bool = False
) -> Camera:
    """A camera with the lens of a CameraInfo.

    Args:
        message: the CameraInfo.
        T_camera_lidar: (4, 4) the guess, to the camera's optical frame that the message names, as
            tf2's ``lookup_transform(target=camera_optical, source=lidar)``.
        rectified: whether the images are: by R, and of the camera matrix P.
        frame_of_first: whether the message of a stereo pair's second camera names the frame of the
            first, so that the baseline in P counts.

    Raises:
        FileError: if the camera is not calibrated, its lens model is unknown, a value is no lens's,
            or the transform is none.
    """
    where = describe_message(message)
    stated = lens_of(message, where, rectified=rectified)
    T_image_frame = stated.T_image_frame(with_baseline=frame_of_first)
    return checked_model(
        Camera, {**stated.lens.fields(), "T_camera_lidar": T_image_frame @ T_camera_lidar}, where
    )


def stated_baseline(message: Any) -> Array:
    """(3,) t of P = K [I t] [m]; zeros if P is no camera's."""
    P = np.reshape(_field(message, "P"), (3, 4))
    if not (np.isfinite(P).all() and P[0, 0] > 0 and P[1, 1] > 0 and P[2, 2] > 0):
        return np.zeros(3)
    return np.asarray(np.linalg.solve(P[:, :3], P[:, 3]), dtype=np.float64)


def _field(message: Any, name: str) -> Array:
    """A matrix: upper case in ROS 1, lower in ROS 2."""
    value = getattr(message, name, None)
    return np.array(getattr(message, name.lower()) if value is None else value, np.float64)
