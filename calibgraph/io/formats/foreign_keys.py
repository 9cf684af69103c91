"""Cameras and transforms under the keys of other programs, which ``foreign_keys.yaml`` lists.

A camera is any mapping that holds the numbers of a lens, at any depth of a YAML or JSON file.
Kalibr's camchain and ROS's CameraInfo are read so, too.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ConfigDict

from calibgraph.arrays import Array
from calibgraph.errors import FileError
from calibgraph.files import StrictNumbers, checked_model, holds_truth_value
from calibgraph.io.lenses import (
    CameraLens,
    fitted_coefficients,
    intrinsics_of_matrix,
    listed_intrinsics,
    stated_model,
    unified_coefficients,
)
from calibgraph.io.rig_parts import ONLY_CAMERA, RigParts, pose_of_quaternion, relative_pose
from calibgraph.model.geometry import invert
from calibgraph.model.rig import Intrinsics, RelativePose, Size, plain_key, rigid_transform
from calibgraph.yaml_text import describe_value, parse_yaml
from factors import LensModel
from factors.lens import COEFFICIENTS

DERIVED = "computed from T_cam_lidar"
"""States of a T_cn_cnm1 that it is no measurement."""
_DEEPEST = 6
_SAME = 1e-6  # of transforms that are given twice: they may be rounded
_FISHEYE_COUNT = 4
_ADD = "add the line `distortion_model: fisheye` or `distortion_model: plumb_bob` to the file"


@cache
def foreign_keys() -> dict[str, Any]:
    """The table, with the keys of lenses, groups, transforms and of what is not read in plain."""
    file = files(__package__) / "foreign_keys.yaml"
    table = parse_yaml(file.read_text("utf-8"), "foreign_keys.yaml")
    table["lens"] = {quantity: [*map(plain_key, keys)] for quantity, keys in table["lens"].items()}
    table["groups"] = [*map(plain_key, table["groups"])]
    for row in table["transforms"]:
        row["keys"] = [*map(plain_key, row["keys"])]
    table["not_read"] = {plain_key(row["key"]): row["why"] for row in table["not_read"]}
    return table


def read_foreign(content: dict[str, Any], path: Path, name: str | None) -> RigParts | None:
    """The cameras and transforms of a mapping; None if it holds none."""
    content = _camchain(content, path) if "cam0" in content else content
    maps = [_Map(above, path, each) for above, each in _maps(content)]
    cameras = [each for each in maps if each.holds_a_lens]
    single = len(cameras) == 1
    owner = (name or cameras[0].name or path.stem) if single else name or ONLY_CAMERA
    lenses: dict[str, CameraLens] = {}
    extrinsics: dict[str, Array] = {}
    pairs: list[RelativePose] = []
    notes: list[str] = []
    for each in maps:
        camera = owner if single or not each.holds_a_lens else each.name or path.stem
        before = next(reversed(lenses), "")
        if each.holds_a_lens:
            if camera in lenses:
                raise FileError(path, f"gives two cameras the name {camera!r}; give each its own")
            lenses[camera], note = each.lens()
            notes += [note] if note else []
        for row, T in each.transforms():
            if row["from"] == "camera before":
                pairs += [relative_pose(camera, before, T)] * bool(before)
            else:
                found = T if row["to"] == "camera" else invert(T)
                if np.abs(extrinsics.setdefault(camera, found) - found).max() > _SAME:
                    raise FileError(path, "two of its keys give different T_camera_lidar; keep one")
    if not extrinsics:
        notes += [note for each in maps for note in each.left_out()]
    part = RigParts(path, lenses, extrinsics, tuple(pairs), notes=tuple(notes))
    if part.is_empty and notes:
        raise FileError(path, notes[0].removeprefix(f"{path}: "))
    if part.is_empty and any(each.holds_a_size for each in maps):
        raise FileError(path, "holds no camera matrix; expected the key camera_matrix, K or fx")
    return None if part.is_empty else part


def _camchain(content: dict[str, Any], path: Path) -> dict[str, Any]:
    """Kalibr's camchain: cam0, cam1, ..., xi before the focal lengths, and what our export adds."""
    keys = [key for key in content if re.fullmatch(r"cam\d+", str(key))]
    in_order = sorted(keys, key=lambda key: int(key[3:]))
    try:
        return {key: _of_camchain(key, content[key], path) for key in in_order}
    except (TypeError, IndexError, KeyError, AttributeError) as error:
        raise FileError(path, f"is no calibration of Kalibr: {error}") from error


def _of_camchain(key: str, camera: dict[str, Any], path: Path) -> dict[str, Any]:
    """A camera of a camchain; a T_cn_cnm1 that was computed from T_cam_lidar is no measurement."""
    own = camera.get("calibgraph") or {}
    kept = {**camera, "name": own.get("camera", key)}
    if own.get("T_cn_cnm1") == DERIVED:
        del kept["T_cn_cnm1"]
    if stated_model(camera, path) == "omnidirectional":
        kept["xi"], *kept["intrinsics"] = camera["intrinsics"]
    return {key: value for key, value in kept.items() if key not in ("calibgraph", "rostopic")}


def _maps(content: Any, above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """The mappings in a content with the keys above them; a lens keeps its groups."""
    if isinstance(content, dict):
        yield above, content
    children = content.items() if isinstance(content, dict) else enumerate(content)
    for key, value in children if len(above) < _DEEPEST else ():
        is_list = isinstance(value, list) and any(isinstance(each, dict) for each in value)
        is_map = isinstance(value, dict) and "data" not in value and not _is_group(key)
        if is_list or is_map:
            yield from _maps(value, (*above, str(key)))


class _Map:
    """A mapping in a file, with the keys that lead to it."""

    def __init__(self, above: tuple[str, ...], path: Path, content: Mapping[str, Any]) -> None:
        self._where = ": ".join([str(path), *above])
        self._content = _flat(content)
        self._keys: dict[str, str] = {}
        of_lens = {alias for aliases in foreign_keys()["lens"].values() for alias in aliases}
        for key, value in self._content.items():
            other = self._keys.setdefault(_plain(key), key)
            if _plain(key) in of_lens and value != self._content[other]:
                raise FileError(self._where, f"{other} and {key} differ; give one camera per file")
        given = (self._content[self._keys[n]] for n in ("cameraname", "name") if n in self._keys)
        texts = [str(each) for each in given if isinstance(each, (str, int)) and each]
        keys = [
            k for k in above if k not in foreign_keys()["above"] and re.fullmatch(r"[\w.-]+", k)
        ]
        self.name = "".join(texts[:1]).strip("/").replace("/", "_") or "".join(keys[-1:])

    @property
    def holds_a_lens(self) -> bool:
        """Whether there is a camera matrix, or focal lengths."""
        matrix = self._key("K")
        is_matrix = matrix is not None and isinstance(self._content[matrix], (list, dict))
        return is_matrix or self._key("fx") is not None

    @property
    def holds_a_size(self) -> bool:
        """Whether there is the size of an image."""
        return any(self._key(name) is not None for name in ("width", "size"))

    def lens(self) -> tuple[CameraLens, str]:
        """The lens, and a note on what was assumed; empty if nothing was."""
        window = self._content.get("roi")
        binned = [self._content.get(key) not in (None, 0, 1) for key in ("binning_x", "binning_y")]
        if any(binned) or (isinstance(window, dict) and any(window.values())):
            raise FileError(self._where, "states binning or a window (roi), which only bags are "
                            "read with: give the lens of the images as they are")  # fmt: skip
        model, coefficients, note = self._distortion(stated_model(self._content, self._where))
        shift = self._key("time_offset_s")
        offset_s = None if shift is None else self._number(shift)
        return CameraLens(model, self._size(), self._intrinsics(), coefficients, offset_s), note

    def transforms(self) -> Iterator[tuple[dict[str, Any], Array]]:
        """The rows of the table whose keys are here, with their (4, 4)."""
        for row in foreign_keys()["transforms"]:
            if self._keys.keys() >= {*row["keys"]}:
                yield row, self._transform([self._keys[key] for key in row["keys"]])

    def left_out(self) -> Iterator[str]:
        """Notes on what is known and not read."""
        for plain, why in foreign_keys()["not_read"].items():
            if plain in self._keys:
                yield (
                    f"{self._where}: {self._keys[plain]} is not read: {why}; give T_camera_lidar, "
                    "or the frames of both"
                )

    def _transform(self, keys: list[str]) -> Array:
        """(4, 4) of 3 or 4 rows, of a place and a quaternion, or of a rotation and a place."""
        parts = [self._numbers(key).ravel() for key in keys]
        where = f"{self._where}: {' and '.join(keys)}"
        expected = {1: ((16,), (12,), (7,)), 2: ((9, 3),)}[len(keys)]
        sizes = tuple(part.size for part in parts)
        if sizes not in expected:
            named = {16: "4 x 4", 12: "3 x 4", 7: "x y z and a quaternion", 9: "3 x 3", 3: "3 x 1"}
            wanted = " or ".join(" and ".join(named[n] for n in each) for each in expected)
            found = " and ".join(map(str, sizes))
            raise FileError(where, f"has {found} numbers, expected {wanted}")
        try:
            if sizes == (7,):
                return pose_of_quaternion(parts[0][:3].tolist(), parts[0][3:].tolist())
            rows = parts[0][:12].reshape(3, 4) if len(parts) == 1 else np.hstack(
                [parts[0].reshape(3, 3), parts[1].reshape(3, 1)])  # fmt: skip
            return rigid_transform(np.vstack([rows, [0, 0, 0, 1]]))
        except ValueError as error:
            raise FileError(where, str(error)) from error

    def _key(self, quantity: str) -> str | None:
        aliases = foreign_keys()["lens"][quantity]
        given = [self._keys[alias] for alias in aliases if alias in self._keys]
        for other in given[1:]:
            if self._content[other] != self._content[given[0]]:
                raise FileError(self._where, f"{given[0]} and {other} differ; keep the right one")
        return given[0] if given else None

    def _numbers(self, key: str) -> Array:
        return numbers(self._content[key], f"{self._where}: {key}")

    def _number(self, key: str) -> float:
        return number(self._content[key], f"{self._where}: {key}")

    def _intrinsics(self) -> Intrinsics:
        matrix = self._key("K")
        if matrix is None:
            keys = {name: self._key(name) for name in Intrinsics.model_fields}
            for name, key in keys.items():
                if key is None:
                    raise FileError(self._where, f"key {name!r} is missing; add it")
            return listed_intrinsics([self._number(key) for key in keys.values() if key],
                                     self._where)  # fmt: skip
        where, found = f"{self._where}: {matrix}", self._numbers(matrix)
        if found.size == len(Intrinsics.model_fields):
            return listed_intrinsics(found.ravel().tolist(), where)
        if found.size != 9:  # noqa: PLR2004 - 3 x 3
            raise FileError(where, f"has {found.size} numbers, expected 3 x 3 or fx, fy, cx, cy")
        return intrinsics_of_matrix(found.reshape(3, 3), where)

    def _size(self) -> tuple[int, int] | None:
        width, height, size = (self._key(name) for name in ("width", "height", "size"))
        if width is not None or height is not None:
            for name, key in (("width", width), ("height", height)):
                if key is None:
                    raise FileError(self._where, f"the {name} of the image is missing; add it")
            given = [self._content[key] for key in (width, height) if key]
        elif size is not None:
            found = self._numbers(size).ravel().tolist()
            given = [int(value) if value == int(value) else value for value in found]
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
            values = self._named_coefficients(model, stated)
        else:
            found = self._numbers(key)
            note = "" if stated or xi else self._assume(found, key)
            values = found.ravel().tolist()
        if model == "omnidirectional":
            if xi is None and len(values) != max(COEFFICIENTS[model]):
                raise FileError(self._where, "key 'xi' is missing; add it")
            mirror, *others = values if xi is None else [self._number(xi), *values]
            return model, unified_coefficients(mirror, others, self._where), note
        listed = key is not None
        return model, fitted_coefficients(values, model, self._where, listed=listed), note

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

    def _named_coefficients(self, model: LensModel, stated: LensModel | None) -> list[float]:
        """The coefficients that have a key each, as k1 or d0."""
        plain = {f"{part}{i}" for part in ("d", "camd") for i in range(8)} & self._keys.keys()
        if plain:
            return [self._number(self._keys[name]) for name in sorted(plain)]
        names = foreign_keys()["coefficients"]
        from_k2 = model == "fisheye" and "k5" in self._keys and "k1" not in self._keys
        listed = names["camodocal" if from_k2 else model if model in names else "pinhole"]
        values = [self._number(self._keys[n]) if n in self._keys else 0.0 for n in listed]
        if stated is None and any(values) and not {"p1", "xi"} & self._keys.keys():
            raise FileError(self._where, f"k1, k2, ... without p1, p2 may be of a fisheye, and no "
                            f"key names the lens model; {_ADD}")  # fmt: skip
        return values


class Foreign(StrictNumbers):
    """Of another program's file: what is not needed may be there."""

    model_config = ConfigDict(extra="ignore")


class _Image(Foreign):
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


def number(value: Any, where: str) -> float:
    """A number, also as a list or matrix of one."""
    found = numbers(value, where)
    if found.size != 1:
        raise FileError(where, f"has {found.size} numbers, expected one")
    return float(found.item())


def _plain(key: str) -> str:
    """A key without the groups before it, capitals and punctuation."""
    return plain_key(key.replace("/", ".").rsplit(".", 1)[-1])


def _flat(content: Mapping[str, Any]) -> dict[str, Any]:
    """The content with the keys of its groups in place of the groups."""
    found: dict[str, Any] = {}
    for key, value in content.items():
        flat = isinstance(value, dict) and "data" not in value and _is_group(key)
        found |= _flat(value) if flat else {str(key): value}
    return found


def _is_group(key: Any) -> bool:
    """Whether the keys below a key are of the lens around it."""
    return _plain(str(key)) in foreign_keys()["groups"]
