"""Text files of lines: lenses of COLMAP's cameras.txt, and matrices as KITTI and others write them.

COLMAP's pixel (0.5, 0.5) is the centre of the first one. Matrices are lines ``KEY: numbers``:

=======================  ==========================  ==============================================
file                     lines                       direction
=======================  ==========================  ==============================================
calib_cam_to_velo.txt    12 or 16 numbers            p_velo = M p_cam, of KITTI-360's image_00
calib_velo_to_cam.txt    12 numbers, or R: and T:    p_cam = M p_velo
calib_cam_to_pose.txt    image_0k: 12 numbers        p_pose = M p_cam
perspective.txt          P_rect_0k, R_rect_0k,       lenses of the rectified images; p_rectified =
                         S_rect_0k                   R_rect_00 p_cam, p_k = p_rectified + K^-1 P[3]
=======================  ==========================  ==============================================
"""

import math
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import FileError
from calibgraph.files import read_text
from calibgraph.io.clouds import read_npy
from calibgraph.io.formats.foreign_keys import foreign_keys
from calibgraph.io.formats.part import ONLY_CAMERA, FrameLink, Part
from calibgraph.io.formats.rig_export import frame_id
from calibgraph.io.kitti import matrix_of_line
from calibgraph.io.lenses import (
    CameraLens,
    fitted_coefficients,
    intrinsics_of_matrix,
    listed_intrinsics,
)
from calibgraph.model.geometry import invert
from calibgraph.model.rig import rigid_transform

_COLMAP_FIELDS = 4  # before the parameters: id, model, width, height
_TO_LIDAR = re.compile(r"cam[a-z]*_?(to|2)_?(velo|lidar)", re.IGNORECASE)
_TO_CAMERA = re.compile(r"(velo[a-z]*|lidar)_?(to|2)_?cam", re.IGNORECASE)
_EXPECTED = (
    "expected KITTI's lines KEY: NUMBERS (perspective.txt, calib_cam_to_pose.txt), or the numbers "
    "of one matrix in a file with cam_to_velo or velo_to_cam in its name"
)


def read_lines(path: Path, name: str | None) -> Part | None:
    """The lenses and transforms of a file of lines, or of an array; None if it is no such file."""
    if path.suffix.lower() == ".npy":
        array = read_npy(path)
        if array.dtype.kind not in "fiu" or array.size not in (12, 16):
            raise FileError(path, f"holds {array.shape} of {array.dtype}, expected 3 x 4 or 4 x 4")
        return _matrices({"": array.astype(np.float64).ravel().tolist()}, path, name)
    numbered = enumerate(read_text(path).splitlines(), start=1)
    lines = {number: line for number, line in numbered if line.strip()}
    cameras = {k: line.split() for k, line in lines.items() if not line.lstrip().startswith("#")}
    first = next(iter(cameras.values()), [""])
    if path.name == "cameras.txt" or (
        first[0].isdecimal() and len(first) > 1 and first[1][0].isalpha()
    ):
        if not cameras:
            raise FileError(
                path, "holds no camera; expected lines CAMERA_ID MODEL WIDTH HEIGHT ..."
            )
        return Part(path, lenses=dict(_colmap_lens(each, path) for each in cameras.items()))
    head = next(iter(lines.values()), "")
    if ":" in head or len(_row(head)) in (4, 12, 16):
        return _matrices(dict(_keyed(lines.values())), path, name)
    return None


def _colmap_lens(numbered: tuple[int, list[str]], path: Path) -> tuple[str, CameraLens]:
    """The name camera_ID and the lens of a line."""
    number, words = numbered
    where = f"line {number}"
    try:
        identity, name, width, height = int(words[0]), words[1], int(words[2]), int(words[3])
        values = [float(word) for word in words[_COLMAP_FIELDS:]]
    except (IndexError, ValueError) as error:
        raise FileError(path, f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS") from error
    models = foreign_keys().colmap
    if name not in models:
        raise FileError(path, f"{where}: lens model {name!r} is none of calibgraph's; of COLMAP's "
                        f"there are {', '.join(models)}")  # fmt: skip
    model, focals, distorted = models[name]
    count = focals + 2 + distorted
    if len(values) != count or not all(map(math.isfinite, values)):
        raise FileError(path, f"{where}: {name} has {count} parameters, found {len(values)}")
    cx, cy = (centre - 0.5 for centre in values[focals : focals + 2])
    K = listed_intrinsics((values[0], values[focals - 1], cx, cy), f"{path}: {where}")
    distortion = fitted_coefficients(values[focals + 2 :], model, path)
    return f"camera_{identity}", CameraLens(model, (width, height), K, distortion)


def _matrices(lines: dict[str, list[float]], path: Path, name: str | None) -> Part:
    """The lenses and transforms of matrices by key."""
    poses = {key: row for key, row in lines.items() if re.fullmatch(r"image_\d+", key)}
    rectified = sorted(key[-2:] for key in lines if re.fullmatch(r"P_rect_\d\d", key))
    if poses:
        return Part(path, links=tuple(FrameLink("pose", f"{key}_optical", _rigid(row, path, key))
                                      for key, row in poses.items()))  # fmt: skip
    if rectified:
        return _rectified(lines, rectified, path)
    camera = name or ("image_00" if path.stem == "calib_cam_to_velo" else ONLY_CAMERA)
    link = FrameLink(f"{frame_id(camera)}_optical", "velodyne", _T_camera_lidar(lines, path))
    return Part(path, links=(link,))


def _rectified(lines: dict[str, list[float]], numbers: list[str], path: Path) -> Part:
    """The lenses of rectified images, and the frames of their cameras.

    The first is turned by its rectification; others are shifted against it, as P = K [I | b] has
    p_k = p_first + b.
    """
    lenses, links = {}, []
    for k in numbers:
        P = _matrix(lines, f"P_rect_{k}", (3, 4), path)
        K = intrinsics_of_matrix(P[:, :3], f"{path}: P_rect_{k}")
        width, height = _matrix(lines, f"S_rect_{k}", (1, 2), path)[0]
        lenses[f"image_{k}"] = CameraLens("pinhole", (int(width), int(height)), K, ())
        parent, T_k_parent = f"image_{k}_optical", np.eye(4)
        if P[:, 3].any():
            parent = f"image_{numbers[0]}_optical_frame"
            T_k_parent[:3, 3] = np.linalg.solve(P[:, :3], P[:, 3])
        else:
            T_k_parent[:3, :3] = _matrix(lines, f"R_rect_{k}", (3, 3), path)
        T = invert(_rigid(T_k_parent.ravel().tolist(), path, f"R_rect_{k}"))
        links.append(FrameLink(parent, f"image_{k}_optical_frame", T))
    return Part(path, lenses, links=tuple(links))


def _T_camera_lidar(lines: dict[str, list[float]], path: Path) -> Array:
    """(4, 4) of the one matrix of a file, in the direction that its name states."""
    if {"R", "T"} <= lines.keys():
        R, t = _matrix(lines, "R", (3, 3), path), _matrix(lines, "T", (3, 1), path)
        row = np.hstack([R, t]).ravel().tolist()
    elif set(lines) == {""}:
        row = lines[""]
    else:
        raise FileError(path, f"has the lines {', '.join(lines)}; {_EXPECTED}")
    to_lidar, to_camera = (bool(each.search(path.stem)) for each in (_TO_LIDAR, _TO_CAMERA))
    if to_lidar == to_camera:
        raise FileError(
            path, "holds a matrix, and its name states no direction; name the file cam_to_velo.txt "
            "if p_velo = M p_cam, velo_to_cam.txt if p_cam = M p_velo"
        )  # fmt: skip
    T = _rigid(row, path, "the matrix")
    return invert(T) if to_lidar else T


def _keyed(lines: Iterable[str]) -> Iterator[tuple[str, list[float]]]:
    """The numbers of each key; those without a key together. KITTI's calib_time is a date."""
    bare: list[float] = []
    for line in lines:
        key, colon, values = line.rpartition(":")
        if colon and not line.split(":")[0].strip().endswith("time"):
            yield key.strip(), _row(values)
        elif not colon:
            bare += _row(line)
    if bare:
        yield "", bare


def _row(text: str) -> list[float]:
    """The numbers of a line; none if it holds a word."""
    try:
        return [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        return []


def _matrix(lines: dict[str, list[float]], key: str, shape: tuple[int, int], path: Path) -> Array:
    return matrix_of_line(path, key, np.array(lines.get(key, [])), shape)


def _rigid(row: list[float], path: Path, what: str) -> Array:
    """(4, 4) of 12 or 16 numbers."""
    if len(row) not in (12, 16):
        raise FileError(path, f"{what} has {len(row)} numbers, expected 12 or 16; {_EXPECTED}")
    rows = row if len(row) == 16 else [*row, 0.0, 0.0, 0.0, 1.0]  # noqa: PLR2004 - 4 x 4
    try:
        return rigid_transform(np.reshape(rows, (4, 4)))
    except ValueError as error:
        raise FileError(path, f"{what}: {error}") from error
