"""COLMAP's cameras.txt: lenses by number; its pixel (0.5, 0.5) is the centre of the first one."""

import math
from pathlib import Path

from calibgraph.errors import FileError
from calibgraph.files import read_text
from calibgraph.io.formats.part import Part
from calibgraph.io.lenses import CameraLens, fitted_coefficients, listed_intrinsics
from factors import LensModel

_HALF_PIXEL = 0.5
_FIELDS = 4  # before the parameters: id, model, width, height
_MODELS: dict[str, tuple[LensModel, int, int]] = {
    "SIMPLE_PINHOLE": ("pinhole", 1, 0),
    "PINHOLE": ("pinhole", 2, 0),
    "SIMPLE_RADIAL": ("pinhole", 1, 1),
    "RADIAL": ("pinhole", 1, 2),
    "OPENCV": ("pinhole", 2, 4),
    "FULL_OPENCV": ("pinhole", 2, 8),
    "OPENCV_FISHEYE": ("fisheye", 2, 4),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", 1, 1),
    "RADIAL_FISHEYE": ("fisheye", 1, 2),
}
"""Per model: that here, its number of focal lengths, and of coefficients after the centre."""


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
    model, focals, distorted = _MODELS[name]
    count = focals + 2 + distorted
    if len(values) != count or not all(math.isfinite(value) for value in values):
        raise FileError(path, f"{where}: {name} has {count} parameters, found {words[_FIELDS:]}")
    fx, fy = values[0], values[focals - 1]
    cx, cy = (centre - _HALF_PIXEL for centre in values[focals : focals + 2])
    shifted = listed_intrinsics((fx, fy, cx, cy), f"{path}: {where}")
    coefficients = fitted_coefficients(values[focals + 2 :], model, path)
    return f"camera_{identity}", CameraLens(model, (width, height), shifted, coefficients)
