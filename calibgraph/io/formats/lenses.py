"""Lens models under the names of others; what a format cannot carry is refused, not rounded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibgraph.errors import CalibrationError, FileError
from calibgraph.model.rig import MODELS_OF_OTHERS, Camera
from factors import LensModel
from factors.lens import COEFFICIENTS, ORDERS
from factors.wide_lenses import check_mirror


@dataclass(frozen=True)
class CameraLens:
    """A lens as a file of others has it.

    Attributes:
        model: the name here.
        size_px: width and height; None if the file has none.
        intrinsics_px: fx, fy, cx, cy; (0, 0) is the centre of the top-left pixel.
        distortion: in OpenCV's order.
    """

    model: LensModel
    size_px: tuple[int, int] | None
    intrinsics_px: tuple[float, float, float, float]
    distortion: tuple[float, ...]


def lens_model(name: str, path: Path) -> LensModel:
    """The model here of a name in a file of others.

    Raises:
        FileError: if calibgraph has no such lens.
    """
    key = name.strip().lower().replace("-", "_").replace(" ", "_")
    if key in ("none", ""):
        return "pinhole"
    ours = {model: model for model in COEFFICIENTS}
    found = ours.get(key) or MODELS_OF_OTHERS.get(key)  # type: ignore[call-overload]
    if found is None:
        raise FileError(
            path,
            f"lens model {name!r} is none of calibgraph's: pinhole (plumb_bob, radtan, "
            "rational_polynomial), fisheye (equidistant, Kannala-Brandt), omnidirectional (omni, "
            "Mei) and equirectangular; calibrate the intrinsics with one of these",
        )
    return found


def unified_coefficients(xi: float, values: Sequence[float], path: Path) -> tuple[float, ...]:
    """The coefficients here of the unified model: xi, and k1, k2, p1, p2 of others, or none.

    Raises:
        FileError: if there is another number of coefficients, or xi is out of range.
    """
    try:
        check_mirror(xi)
    except ValueError as error:
        raise FileError(path, str(error)) from error
    kept = fitted_coefficients(values, "pinhole", path) or (0.0,) * 4
    if any(kept[4:]):
        raise FileError(
            path,
            f"{len(values)} distortion coefficients; the unified model here has k1, k2, p1, p2",
        )
    return (xi, *kept[:4])


def fitted_coefficients(values: Sequence[float], model: LensModel, path: Path) -> tuple[float, ...]:
    """Distortion coefficients in a number that the model has: zeros at the end come and go.

    Raises:
        FileError: if there are more coefficients than the model has.
    """
    kept = tuple(float(value) for value in np.trim_zeros(np.array(values, dtype=float), "b"))
    if model == "pinhole" and not kept:
        return ()
    for count in COEFFICIENTS[model]:
        if count >= len(kept):
            return kept + (0.0,) * (count - len(kept))
    raise FileError(
        path,
        f"{len(values)} distortion coefficients, of which {len(kept)} count; the lens model "
        f"{model} here has {ORDERS[model]}",
    )


def listed_coefficients(values: Sequence[float], model: LensModel, path: Path) -> tuple[float, ...]:
    """As :func:`fitted_coefficients`, of formats that list as many as OpenCV does.

    Raises:
        FileError: if there are more or fewer than the model has.
    """
    fewest = min((count for count in COEFFICIENTS[model] if count), default=0)
    if 0 < len(values) < fewest:
        raise FileError(
            path,
            f"{len(values)} distortion coefficients, the lens model {model} has {ORDERS[model]}; "
            "add those that are missing, zero if they are",
        )
    return fitted_coefficients(values, model, path)


def carried_coefficients(name: str, camera: Camera, most: int, what: str) -> list[float]:
    """A pinhole's coefficients, ``most`` of them, in OpenCV's order.

    Raises:
        CalibrationError: if there are further ones that are not zero.
    """
    padded = [*camera.distortion, *[0.0] * most]
    if any(padded[most:]):
        raise CalibrationError(
            f"camera {name!r}: {what} holds {most or 'no'} distortion coefficients, this lens has "
            f"{camera.distortion}; choose another --format (opencv, json)",
            camera=name,
        )
    return padded[:most]


def no_place_for(name: str, camera: Camera, what: str) -> CalibrationError:
    """The error of a format that has no place for a camera's lens model."""
    return CalibrationError(
        f"camera {name!r}: {what} cannot hold a lens of the model {camera.model}; choose another "
        "--format (opencv, json)",
        camera=name,
    )


def require_undistorted(name: str, camera: Camera, what: str) -> None:
    """Check that a camera is a pinhole without distortion.

    Raises:
        CalibrationError: if not.
    """
    if camera.model != "pinhole":
        raise CalibrationError(
            f"camera {name!r}: {what} cannot hold a {camera.model} lens; choose another --format, "
            "or undistort the images and calibrate these",
            camera=name,
        )
    carried_coefficients(name, camera, 0, what)
