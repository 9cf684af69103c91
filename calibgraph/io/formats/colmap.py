"""COLMAP's cameras.txt: lenses by number; its pixel (0.5, 0.5) is the centre of the first one."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

from calibgraph.errors import FileError
from calibgraph.files import read_text
from calibgraph.io.formats.part import Part
from calibgraph.io.lenses import CameraLens, fitted_coefficients, listed_intrinsics
from factors import LensModel

_HALF_PIXEL = 0.5
_Values = Sequence[float]
_FIELDS = 4  # before the parameters: id, model, width, height


def _one_focal(p: _Values) -> tuple[float, float, float, float]:
    return p[0], p[0], p[1], p[2]


def _two_focals(p: _Values) -> tuple[float, float, float, float]:
    return p[0], p[1], p[2], p[3]


_MODELS: dict[
    str, tuple[int, LensModel, Callable[[_Values], tuple[float, float, float, float]], int]
] = {
    "SIMPLE_PINHOLE": (3, "pinhole", _one_focal, 3),
    "PINHOLE": (4, "pinhole", _two_focals, 4),
    "SIMPLE_RADIAL": (4, "pinhole", _one_focal, 3),
    "RADIAL": (5, "pinhole", _one_focal, 3),
    "OPENCV": (8, "pinhole", _two_focals, 4),
    "FULL_OPENCV": (12, "pinhole", _two_focals, 4),
    "OPENCV_FISHEYE": (8, "fisheye", _two_focals, 4),
    "SIMPLE_RADIAL_FISHEYE": (4, "fisheye", _one_focal, 3),
    "RADIAL_FISHEYE": (5, "fisheye", _one_focal, 3),
}
"""Per model: number of parameters, model here, its focal lengths and centre, their number."""


def is_colmap(text: str) -> bool:
    """Whether the first line that is no comment begins as COLMAP's: a number and a model."""
    lines = (line.split() for line in text.splitlines() if not line.lstrip().startswith("#"))
    words = next((line for line in lines if line), [""])
    return words[0].isdecimal() and len(words) > 1 and words[1][0].isalpha()


def read_colmap(path: Path) -> Part:
    """The lenses, named camera_ID."""
    lenses = {}
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            name, lens = _lens(line.split(), path, number)
            lenses[name] = lens
    if not lenses:
        raise FileError(path, "holds no camera; expected lines CAMERA_ID MODEL WIDTH HEIGHT ...")
    return Part(path, lenses=lenses)


def _lens(words: list[str], path: Path, number: int) -> tuple[str, CameraLens]:
    where = f"line {number}"
    try:
        identity, name, width, height = int(words[0]), words[1], int(words[2]), int(words[3])
        values = [float(word) for word in words[_FIELDS:]]
    except (IndexError, ValueError) as error:
        raise FileError(path, f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS") from error
    if name not in _MODELS:
        raise FileError(
            path, f"{where}: lens model {name!r} is none of calibgraph's; of COLMAP's there are "
            f"{', '.join(_MODELS)}"
        )  # fmt: skip
    count, model, intrinsics, start = _MODELS[name]
    if len(values) != count or not all(math.isfinite(value) for value in values):
        raise FileError(path, f"{where}: {name} has {count} parameters, found {words[_FIELDS:]}")
    fx, fy, cx, cy = intrinsics(values)
    shifted = listed_intrinsics((fx, fy, cx - _HALF_PIXEL, cy - _HALF_PIXEL), f"{path}: {where}")
    coefficients = fitted_coefficients(values[start:], model, path)
    return f"camera_{identity}", CameraLens(model, (width, height), shifted, coefficients)
