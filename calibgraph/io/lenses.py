"""Lenses as others write them: their model by any of its names, K, and lists of coefficients."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibgraph.errors import FileError
from calibgraph.files import checked_model
from calibgraph.model.rig import KNOWN_LENSES, Intrinsics, find_lens_model, plain_key
from factors import LensModel
from factors.lens import COEFFICIENTS, ORDERS, check_mirror

_ROUNDED = 1e-6  # of numbers that are 0 or 1: what writing and reading them may add
_NO_SKEW = 1e-4
"""Skew over fx is the angle [rad] by which columns lean: 0.006 deg, a tenth of a good sigma."""

_PROJECTION_KEYS = (
    "model", "cameramodel", "cammodel", "modeltype", "cameramodeltype", "cameratype", "camtype",
    "projectionmodel", "projectiontype", "lensmodel", "lenstype", "type",
)  # fmt: skip
_DISTORTION_KEYS = (
    "distortionmodel", "distmodel", "distortiontype", "disttype", "isfisheye", "fisheyemodel",
)  # fmt: skip
_FLAGS = ("isfisheye", "fisheyemodel", "distortiontype")
"""Where 1 is a fisheye, and 0 is none: of OpenCV's samples and of MC-Calib."""
_NONE = "none"
_PERSPECTIVE = ("pinhole", "perspective", "pinholecamera")
"""Names that leave the distortion to another key."""


@dataclass(frozen=True)
class CameraLens:
    """A lens as a file of others has it.

    Attributes:
        model: the name here.
        size_px: width and height; None if the file has none.
        intrinsics_px: (0, 0) is the centre of the top-left pixel.
        distortion: in OpenCV's order.
        time_offset_s: of its images to the clouds, if the file has it.
        stated: further fields of :class:`calibgraph.Camera`: sigmas, and the read-out.
    """

    model: LensModel
    size_px: tuple[int, int] | None
    intrinsics_px: Intrinsics
    distortion: tuple[float, ...]
    time_offset_s: float | None = None
    stated: Mapping[str, Any] = field(default_factory=dict)

    def fields(self) -> dict[str, Any]:
        """The fields of :class:`calibgraph.Camera` without the extrinsic."""
        width_px, height_px = self.size_px or (None, None)
        return {
            "model": self.model,
            "width_px": width_px,
            "height_px": height_px,
            "intrinsics_px": self.intrinsics_px,
            "distortion": self.distortion,
            "time_offset_s": self.time_offset_s,
            **self.stated,
        }


def lens_model(name: str, where: Path | str) -> LensModel:
    """The model here of a name in a file of others."""
    found = find_lens_model(name)
    if found is None:
        raise FileError(
            where,
            f"lens model {name!r} is none of calibgraph's, which are {KNOWN_LENSES}; calibrate the "
            "intrinsics with one of these",
        )
    return found


def stated_model(content: Mapping[str, Any], where: Path | str) -> LensModel | None:
    """The lens model that the keys of a mapping name, in any of their spellings; None if none does.

    A pinhole with the distortion of a fisheye is a fisheye, as in Kalibr; an omnidirectional lens
    may have the distortion of a pinhole.
    """
    named = {str(key): _model_name(str(key), value) for key, value in content.items()}
    kept = {key: name for key, name in named.items() if name}
    models = {key: lens_model(name, where) for key, name in kept.items() if name != _NONE}
    lenses = {model for key, model in models.items() if plain_key(key) in _PROJECTION_KEYS}
    distortions = {model for key, model in models.items() if plain_key(key) in _DISTORTION_KEYS}
    ideal = all(plain_key(kept[key]) in _PERSPECTIVE for key in models if models[key] == "pinhole")
    if (lenses, distortions) == ({"pinhole"}, {"fisheye"}) and ideal:
        return "fisheye"
    if (lenses, distortions) == ({"omnidirectional"}, {"pinhole"}):
        return "omnidirectional"
    if len(lenses | distortions) > 1:
        stated = " and ".join(f"{key} {kept[key]!r}" for key in models)
        raise FileError(where, f"{stated} contradict each other; keep the one that is right")
    return next(iter(lenses | distortions), "pinhole" if kept else None)


def _model_name(key: str, value: Any) -> str:
    """The model that a key names; empty if it is none of the keys that do."""
    plain = plain_key(key)
    if plain in _FLAGS and isinstance(value, int):
        return "fisheye" if value else _NONE
    is_name = plain in (*_PROJECTION_KEYS, *_DISTORTION_KEYS) and isinstance(value, (str, int))
    name = str(value).strip() if is_name else ""
    return _NONE if plain_key(name) == _NONE else name


def unified_coefficients(xi: float, values: Sequence[float], path: Path | str) -> tuple[float, ...]:
    """The coefficients here of the unified model: xi, and k1, k2, p1, p2 of others, or none."""
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


def fitted_coefficients(
    values: Sequence[float], model: LensModel, path: Path | str, *, listed: bool = False
) -> tuple[float, ...]:
    """Distortion coefficients in a number that the model has: zeros at the end come and go.

    ``listed`` are those of formats that list as many as OpenCV does.
    """
    fewest = min((count for count in COEFFICIENTS[model] if count), default=0)
    if listed and 0 < len(values) < fewest:
        raise FileError(
            path,
            f"{len(values)} distortion coefficients, the lens model {model} has {ORDERS[model]}; "
            "add those that are missing, zero if they are",
        )
    kept = tuple(float(value) for value in np.trim_zeros(np.array(values, dtype=float), "b"))
    if model == "pinhole" and not kept:
        return ()
    for count in COEFFICIENTS[model]:
        if count >= len(kept):
            return kept + (0.0,) * (count - len(kept))
    raise FileError(
        path,
        f"{len(values)} distortion coefficients, {len(kept)} without zeros; the lens model "
        f"{model} here has {ORDERS[model]}",
    )


def intrinsics_of_matrix(K: ArrayLike, where: Path | str) -> Intrinsics:
    """The focal lengths and the principal point of a (3, 3) camera matrix [px]."""
    found = np.array(K, dtype=np.float64)
    if found.shape != (3, 3):
        raise FileError(where, f"has the shape {found.shape}, expected a 3x3 camera matrix")
    fx, fy, cx, cy = found[0, 0], found[1, 1], found[0, 2], found[1, 2]
    if not (np.isfinite(found).all() and fx > 0 and fy > 0):
        raise FileError(
            where,
            f"is no camera matrix: {found.tolist()} holds no focal length, so the camera is not "
            "calibrated; calibrate its lens, or use a rig that has it (--rig)",
        )
    excess = np.abs(found - [[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    excess[0, 1] = max(0.0, excess[0, 1] - _NO_SKEW * fx)
    if excess.max() > _ROUNDED:
        raise FileError(
            where,
            f"begins with {found.tolist()}, expected [fx 0 cx; 0 fy cy; 0 0 1]; {_remedy(found)}",
        )
    return checked_model(Intrinsics, {"fx": fx, "fy": fy, "cx": cx, "cy": cy}, where)


def listed_intrinsics(values: Sequence[float], where: Path | str) -> Intrinsics:
    """Those that a file lists as fx, fy, cx, cy [px]."""
    if len(values) != len(Intrinsics.model_fields):
        raise FileError(where, f"has {len(values)} numbers, expected fx, fy, cx, cy")
    return checked_model(Intrinsics, dict(zip(Intrinsics.model_fields, values, strict=True)), where)


def _remedy(K: NDArray[np.float64]) -> str:
    if abs(K[0, 1]) > _NO_SKEW * K[0, 0] and not K[1:, 0].any():
        return (
            f"its skew is {K[0, 1]:.6g} px, and lenses here have none: calibrate the lens without "
            "skew, or undistort the images"
        )
    if np.abs(K[2, :2]).max() > _ROUNDED and np.abs(K[:2, 2]).max() <= _ROUNDED:
        return "it looks transposed: write its rows first"
    if K[2, 2] > _ROUNDED and abs(K[2, 2] - 1) > _ROUNDED:
        return f"undo its scale: divide by {K[2, 2]:.6g}"
    return "write the camera matrix of the calibration"
