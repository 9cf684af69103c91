"""CameraInfo messages as lenses, of the images as recorded or of rectified ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.io.lenses import fitted_coefficients, intrinsics_of_matrix, lens_model

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CameraLens:
    """A lens, as a CameraInfo describes it.

    Attributes:
        frame: the frame of the camera, z forward and y down, as the message names it.
        content: the fields of :class:`calibgraph.Camera` apart from the extrinsic.
        R_image_frame: (3, 3) from the frame to the axes of the image, which rectification turns.
    """

    frame: str
    content: dict[str, Any]
    R_image_frame: Array


def lens_of(message: Any, where: str, *, rectified: bool) -> CameraLens:
    """The lens of a camera's images.

    Args:
        message: a CameraInfo.
        where: its topic, for errors.
        rectified: whether the images are rectified: by R, and of the camera matrix P.

    Raises:
        FileError: if the camera is not calibrated, or its lens model is unknown.
    """
    frame = message.header.frame_id.lstrip("/")
    K = np.reshape(_field(message, "K"), (3, 3))
    if rectified:
        K = np.reshape(_field(message, "P"), (3, 4))[:, :3]
    intrinsics_of_matrix(K, where)
    model, distortion = ("pinhole", []) if rectified else _distortion(message, where)
    R = np.reshape(_field(message, "R"), (3, 3))
    content = {"model": model, "distortion": distortion, **_on_image(message, K)}
    return CameraLens(frame, content, R if rectified and R.any() else np.eye(3))


def _field(message: Any, name: str) -> Array:
    """A matrix: upper case in ROS 1, lower in ROS 2."""
    value = getattr(message, name, None)
    return np.array(getattr(message, name.lower()) if value is None else value, np.float64)


def _on_image(message: Any, K: Array) -> dict[str, Any]:
    """Size and intrinsics of the image: K is of the full sensor, before its window and binning."""
    bins = np.maximum([message.binning_x, message.binning_y], 1)
    window = message.roi
    size = np.array([window.width or message.width, window.height or message.height]) // bins
    corner = np.array([window.x_offset, window.y_offset])
    focal, centre = np.diag(K)[:2] / bins, (K[:2, 2] - corner) / bins
    return {
        "width_px": int(size[0]),
        "height_px": int(size[1]),
        "intrinsics_px": dict(zip(("fx", "fy", "cx", "cy"), (*focal, *centre), strict=True)),
    }


def _distortion(message: Any, where: str) -> tuple[str, list[float]]:
    """Lens model and coefficients; both may be empty for none, and zeros appended."""
    given = _field(message, "D")
    stated = message.distortion_model.strip() or ("" if given.any() else "none")
    model = lens_model(stated, where)
    return model, list(fitted_coefficients(given.tolist(), model, where))
