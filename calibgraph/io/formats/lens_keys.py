"""The lens of a mapping, under the keys that calibration and SLAM programs give its numbers.

One table of keys serves OpenCV, camera_info files, camodocal (VINS), ORB-SLAM and vikit
(FAST-LIVO). Capitals, underscores and what stands before
a dot or slash do not count: ``Camera.fx``, ``cam_fx``.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import FileError
from calibgraph.files import StrictNumbers, checked_model, holds_truth_value
from calibgraph.io.lenses import (
    CameraLens,
    fitted_coefficients,
    intrinsics_of_matrix,
    listed_coefficients,
    listed_intrinsics,
    stated_model,
    unified_coefficients,
)
from calibgraph.model.lens_names import plain_key
from calibgraph.model.rig import Intrinsics, Size
from calibgraph.yaml_text import describe_value
from factors import LensModel
from factors.lens import COEFFICIENTS

_KEYS = {
    "K": (
        "cameramatrix", "cameramat", "k", "camk", "cameraintrinsic", "cameraintrinsics",
        "intrinsicmatrix", "intrinsics", "mtx",
    ),
    "D": (
        "distortioncoefficients", "distortionvector", "distortioncoeffs", "distcoeffs", "distcoeff",
        "cameradistcoeffs", "camdist", "dist", "d", "coefficients", "distortion",
    ),
    "width": ("imagewidth", "imgwidth", "width", "camwidth", "camerawidth", "imgdistw"),
    "height": ("imageheight", "imgheight", "height", "camheight", "cameraheight", "imgdisth"),
    "size": ("imagesize", "resolution"),
    "fx": ("fx", "camfx", "camerafx", "mu", "gamma1"),
    "fy": ("fy", "camfy", "camerafy", "mv", "gamma2"),
    "cx": ("cx", "camcx", "cameracx", "u0"),
    "cy": ("cy", "camcy", "cameracy", "v0"),
    "xi": ("xi",),
}  # fmt: skip
_GROUPS = (
    "projectionparameters", "distortionparameters", "mirrorparameters", "intrinsics", "intrinsic",
    "param", "distortionmodel", "distortion",
)  # fmt: skip
_PINHOLE = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE, _CAMODOCAL = ("k1", "k2", "k3", "k4"), ("k2", "k3", "k4", "k5")
_FISHEYE_COUNT = 4
_LENS_KEYS = frozenset(alias for aliases in _KEYS.values() for alias in aliases)


class LensKeys:
    """The numbers of a lens in a mapping."""

    def __init__(self, content: Mapping[str, Any], where: str) -> None:
        self._where = where
        self._content = _flat(content)
        self._keys: dict[str, str] = {}
        for key, value in self._content.items():
            other = self._keys.setdefault(_plain(key), key)
            if _plain(key) in _LENS_KEYS and value != self._content[other]:
                raise FileError(where, f"{other} and {key} differ; give one camera per file")

    @property
    def hold_a_lens(self) -> bool:
        """Whether there is a camera matrix, or focal lengths."""
        matrix = self._key("K")
        is_matrix = matrix is not None and isinstance(self._content[matrix], (list, dict))
        return is_matrix or self._key("fx") is not None

    @property
    def hold_a_size(self) -> bool:
        """Whether there is the size of an image."""
        return any(self._key(name) is not None for name in ("width", "size"))

    def read(self) -> tuple[CameraLens, str]:
        """The lens, and a note on what was assumed; empty if nothing was."""
        stated = stated_model(self._content, self._where)
        model, coefficients, note = self._distortion(stated)
        return CameraLens(model, self._size(), self._intrinsics(), coefficients), note

    def text(self, *names: str) -> str:
        """The text of the first of some keys; empty without one."""
        found = [self._content[self._keys[name]] for name in names if name in self._keys]
        return next((str(value) for value in found if isinstance(value, (str, int)) and value), "")

    def has(self, name: str) -> bool:
        """Whether there is a key, by its plain name."""
        return name in self._keys

    def key(self, name: str) -> str:
        """A key as it is written, by its plain name."""
        return self._keys[name]

    def array(self, name: str, *shapes: tuple[int, int]) -> Array:
        """The numbers of a plain key in the one of some shapes that they fill."""
        where = f"{self._where}: {self._keys[name]}"
        found = numbers(self._content[self._keys[name]], where)
        for shape in shapes:
            if found.size == shape[0] * shape[1]:
                return found.reshape(shape)
        sizes = " or ".join(f"{rows} x {cols}" for rows, cols in shapes)
        raise FileError(where, f"has {found.size} numbers, expected {sizes}")

    def _key(self, quantity: str) -> str | None:
        """The key of a quantity."""
        given = [self._keys[alias] for alias in _KEYS[quantity] if alias in self._keys]
        for other in given[1:]:
            if self._content[other] != self._content[given[0]]:
                raise FileError(self._where, f"{given[0]} and {other} differ; keep the right one")
        return given[0] if given else None

    def _number(self, key: str) -> float:
        found = numbers(self._content[key], f"{self._where}: {key}")
        if found.size != 1:
            raise FileError(f"{self._where}: {key}", f"has {found.size} numbers, expected one")
        return float(found.item())

    def _intrinsics(self) -> Intrinsics:
        matrix = self._key("K")
        if matrix is None:
            keys = {name: self._key(name) for name in ("fx", "fy", "cx", "cy")}
            for name, key in keys.items():
                if key is None:
                    raise FileError(self._where, f"key {name!r} is missing; add it")
            return listed_intrinsics([self._number(key) for key in keys.values() if key],
                                     self._where)  # fmt: skip
        where = f"{self._where}: {matrix}"
        found = numbers(self._content[matrix], where)
        if found.size == len(Intrinsics.model_fields):
            return listed_intrinsics(found.ravel().tolist(), where)
        if found.size != 9:  # noqa: PLR2004 - 3 x 3
            raise FileError(where, f"has {found.size} numbers, expected 3 x 3")
        return intrinsics_of_matrix(found.reshape(3, 3), where)

    def _size(self) -> tuple[int, int] | None:
        width, height, size = (self._key(name) for name in ("width", "height", "size"))
        if width is not None or height is not None:
            for name, key in (("width", width), ("height", height)):
                if key is None:
                    raise FileError(self._where, f"the {name} of the image is missing; add it")
            given = [self._content[key] for key in (width, height) if key]
        elif size is not None:
            given = numbers(self._content[size], f"{self._where}: {size}").ravel().tolist()
            given = [int(value) if value == int(value) else value for value in given]
        else:
            return None
        return checked_model(_Image, {"size": given}, self._where).size

    def _distortion(self, stated: LensModel | None) -> tuple[LensModel, tuple[float, ...], str]:
        """The model, the coefficients and a note on what was assumed."""
        xi, key, note = self._key("xi"), self._key("D"), ""
        model: LensModel = stated or ("pinhole" if xi is None else "omnidirectional")
        if xi is not None and model != "omnidirectional":
            raise FileError(self._where, f"xi is of an omnidirectional lens, which the {model} is "
                            "not; correct the model")  # fmt: skip
        if key is None:
            values = self._named(model, stated)
        else:
            found = numbers(self._content[key], f"{self._where}: {key}")
            note = "" if stated or xi else self._assume(found, key)
            values = found.ravel().tolist()
        if model == "omnidirectional":
            return model, self._unified(xi, values), note
        fit = fitted_coefficients if key is None else listed_coefficients
        return model, fit(values, model, self._where), note

    def _unified(self, xi: str | None, values: list[float]) -> tuple[float, ...]:
        """Xi and its coefficients; without a key it is the first of five, as in ROS."""
        if xi is None and len(values) != max(COEFFICIENTS["omnidirectional"]):
            raise FileError(self._where, "key 'xi' is missing; add it")
        mirror, *others = values if xi is None else [self._number(xi), *values]
        return unified_coefficients(mirror, others, self._where)

    def _assume(self, found: Array, key: str) -> str:
        """The note on a pinhole that no key states."""
        if found.size != _FISHEYE_COUNT or not found.any():
            return ""
        if found.ndim > 1 and len(found) > 1:
            raise FileError(self._where, f"{key} is a column of four, as of OpenCV's fisheye, and "
                            f"no key names the lens model; {_ADD}")  # fmt: skip
        return (
            f"{self._where}: {key} has four numbers and no key names the lens model: taken for a "
            "pinhole's k1 k2 p1 p2; if it is a fisheye, add the line `distortion_model: fisheye`"
        )

    def _named(self, model: LensModel, stated: LensModel | None) -> list[float]:
        """The coefficients that have a key each, as k1 or d0."""
        plain = {f"{part}{i}" for part in ("d", "camd") for i in range(8)} & self._keys.keys()
        if plain:
            return [self._number(self._keys[name]) for name in sorted(plain)]
        names = {"fisheye": _FISHEYE, "omnidirectional": _PINHOLE[:4]}.get(model, _PINHOLE)
        if model == "fisheye" and "k5" in self._keys and "k1" not in self._keys:
            names = _CAMODOCAL  # r = theta + k2 theta^3 + ... + k5 theta^9
        values = [self._number(self._keys[n]) if n in self._keys else 0.0 for n in names]
        if stated is None and any(values) and not {"p1", "xi"} & self._keys.keys():
            raise FileError(self._where, f"k1, k2, ... without p1, p2 may be of a fisheye, and no "
                            f"key names the lens model; {_ADD}")  # fmt: skip
        return values


_ADD = "add the line `distortion_model: fisheye` or `distortion_model: plumb_bob` to the file"


class _Image(StrictNumbers):
    size: tuple[Size, Size]


def numbers(value: Any, where: str) -> Array:
    """A number, a list, or OpenCV's matrix of rows, cols and data, as an array of its shape."""
    is_matrix = isinstance(value, dict) and "data" in value
    data = value["data"] if is_matrix else value
    try:
        found = np.array(data)
    except ValueError:  # lists of different lengths
        found = np.array("")
    if found.dtype.kind not in "iuf" or holds_truth_value(data) or not np.isfinite(found).all():
        raise FileError(where, f"expected finite numbers, found {describe_value(value)}")
    if is_matrix and "rows" in value and "cols" in value:
        rows, cols = value["rows"], value["cols"]
        if not (type(rows) is type(cols) is int and rows > 0 and rows * cols == found.size):
            raise FileError(where, f"has {describe_value(rows)} rows, {describe_value(cols)} "
                            f"columns and {found.size} numbers")  # fmt: skip
        found = found.reshape(rows, cols)
    return found.astype(np.float64)


def _plain(key: str) -> str:
    """A key without the groups before it, capitals and punctuation."""
    return plain_key(key.replace("/", ".").rsplit(".", 1)[-1])


def _flat(content: Mapping[str, Any]) -> dict[str, Any]:
    """The content with the keys of its groups in place of the groups."""
    found: dict[str, Any] = {}
    for key, value in content.items():
        flat = isinstance(value, dict) and "data" not in value and is_group(key)
        found |= _flat(value) if flat else {str(key): value}
    return found


def is_group(key: Any) -> bool:
    """Whether the keys below a key are of the lens around it."""
    return _plain(str(key)) in _GROUPS
