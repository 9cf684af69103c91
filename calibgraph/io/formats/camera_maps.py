"""Files of named numbers: OpenCV FileStorage, camera_info, parameters of SLAM programs and others.

A camera is any mapping that holds the numbers of a lens, at any depth. These transforms are read;
p are coordinates of a point, for cameras in optical axes (x right, y down, z forward):

=================================  ===========================  ==================================
keys                               program                      direction
=================================  ===========================  ==================================
T_camera_lidar, T_cam_lidar, T_C_L calibgraph, Kalibr-like      p_camera = T p_lidar
Rcl, Pcl                           FAST-LIVO                    p_camera = Rcl p_lidar + Pcl
T_lidar_camera, T_L_C              calibgraph, Kalibr-like      p_lidar = T p_camera
extrinsicRotation, -Translation    VINS-Mono, LVI-SAM           p_imu = R p_camera + t
body_T_cam0, body_T_cam1           VINS-Fusion                  p_imu = T p_camera
Tbc, IMU.T_b_c1                    ORB-SLAM3                    p_imu = T p_camera
extrinsic_R, extrinsic_T           FAST-LIO, FAST-LIVO          p_imu = R p_lidar + t
=================================  ===========================  ==================================
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import FileError
from calibgraph.io.formats.lens_keys import LensKeys, is_group
from calibgraph.io.formats.part import IMU, ONLY_CAMERA, FrameLink, Part
from calibgraph.io.formats.rig_export import frame_id
from calibgraph.io.lenses import CameraLens
from calibgraph.model.geometry import invert
from calibgraph.model.rig import rigid_transform

_LIDAR = "lidar"
_T_CAMERA_LIDAR = (
    ("tcameralidar",), ("tcamlidar",), ("tcl",), ("rcl", "pcl"),
)  # fmt: skip
_T_LIDAR_CAMERA = (("tlidarcamera",), ("tlidarcam",), ("tlc",))
_T_IMU_CAMERA = (
    ("extrinsicrotation", "extrinsictranslation"), ("tbc",), ("tbc1",),
)  # fmt: skip
_T_IMU_LIDAR = ("extrinsicr", "extrinsict")
_BODY = ("bodytcam0", "bodytcam1")
_NOT_READ = {
    "lidartocamtx": "versions of LVI-SAM mean different axes by it",
    "extrinsicrot": "versions of LIO-SAM mean different axes by it",
    "cameraposematrix": "it places cameras against each other, not against a LiDAR",
}
_DEEPEST = 6
_SAME = 1e-6  # of transforms that are given twice: they may be rounded
_PROGRAMS = (
    "ros__parameters", "camera", "cameras", "extrin_calib", "mapping", "param",
    "intrinsic", "value0",
)  # fmt: skip
"""Keys above a camera that are no name of it."""


def read_camera_maps(content: Mapping[str, Any], path: Path, name: str | None) -> Part | None:
    """The cameras and transforms of a mapping; None if it holds none."""
    maps = [_Map(keys, ": ".join([str(path), *keys]), each) for keys, each in _maps(content)]
    cameras = [each for each in maps if each.numbers.hold_a_lens]
    owner = name or ONLY_CAMERA
    if len(cameras) == 1:
        owner = name or cameras[0].name or path.stem
    named = [(_camera_of(each, owner, path, single=len(cameras) == 1), each) for each in maps]
    lenses, notes = _lenses(named, path)
    links = [link for camera, each in named for link in each.links(camera)]
    part = Part(
        path,
        lenses,
        _extrinsics(named, path),
        links=tuple(links),
        frame_ids={
            camera: f"{frame_id(camera)}_optical_frame"
            for camera, each in named
            if any(each.links(camera))
        },
        notes=(*notes, *(note for _, each in named for note in each.notes())),
    )
    if part.is_empty and any(each.numbers.hold_a_size for each in maps):
        raise FileError(path, "holds no camera matrix; expected the key camera_matrix, K or fx")
    return None if part.is_empty else part


def _camera_of(each: _Map, owner: str, path: Path, *, single: bool) -> str:
    """The camera that a mapping is about: its own, or the whole file's."""
    return owner if single or not each.numbers.hold_a_lens else each.name or path.stem


def _lenses(
    named: Iterable[tuple[str, _Map]], path: Path
) -> tuple[dict[str, CameraLens], list[str]]:
    """The lenses by camera, and what was assumed of them."""
    lenses: dict[str, CameraLens] = {}
    notes: list[str] = []
    for camera, each in named:
        if each.numbers.hold_a_lens:
            if camera in lenses:
                raise FileError(path, f"gives two cameras the name {camera!r}; give each its own")
            lenses[camera], note = each.numbers.read()
            notes += [note] if note else []
    return lenses, notes


def _extrinsics(named: Iterable[tuple[str, _Map]], path: Path) -> dict[str, Array]:
    """(4, 4) T_camera_lidar by camera."""
    T: dict[str, Array] = {}
    for camera, each in named:
        for found in each.T_camera_lidar():
            if np.abs(T.setdefault(camera, found) - found).max() > _SAME:
                raise FileError(path, "two of its keys give different T_camera_lidar; keep one")
    return T


class _Map:
    """A mapping in a file, with the keys that lead to it."""

    def __init__(self, above: tuple[str, ...], where: str, content: Mapping[str, Any]) -> None:
        self.numbers = LensKeys(content, where)
        self._where = where
        given = self.numbers.text("cameraname", "name").strip("/").replace("/", "_")
        keys = [key for key in above if key not in _PROGRAMS and re.fullmatch(r"[\w.-]+", key)]
        self.name = given or (keys[-1] if keys else "")

    def _has(self, *names: str) -> bool:
        return all(self.numbers.has(name) for name in names)

    def T_camera_lidar(self) -> Iterator[Array]:
        """(4, 4), each that it holds."""
        for names in _T_CAMERA_LIDAR:
            if self._has(*names):
                yield self._transform(names)
        for names in _T_LIDAR_CAMERA:
            if self._has(*names):
                yield invert(self._transform(names))

    def links(self, camera: str) -> Iterator[FrameLink]:
        """The poses of the camera and of the LiDAR in the IMU."""
        for names in _T_IMU_CAMERA:
            if self._has(*names):
                yield FrameLink(IMU, f"{frame_id(camera)}_optical_frame", self._transform(names))
        for index, name in enumerate(_BODY):
            if self._has(name):
                yield FrameLink(IMU, f"cam{index}_optical_frame", self._transform((name,)))
        if self._has(*_T_IMU_LIDAR):
            yield FrameLink(IMU, _LIDAR, self._transform(_T_IMU_LIDAR))

    def notes(self) -> Iterator[str]:
        """What is left out."""
        for name, why in _NOT_READ.items():
            if self._has(name):
                yield (
                    f"{self._where}: {self.numbers.key(name)} is not read: {why}; give the pose of "
                    "the camera by another file"
                )

    def _transform(self, names: tuple[str, ...]) -> Array:
        """(4, 4) of a matrix of 3 or 4 rows, or of a rotation and a translation."""
        if len(names) == 1:
            rows = self.numbers.array(names[0], (4, 4), (3, 4))
        else:
            rows = np.hstack([self.numbers.array(names[0], (3, 3)),
                              self.numbers.array(names[1], (3, 1))])  # fmt: skip
        try:
            return rigid_transform(np.vstack([rows[:3], [0, 0, 0, 1]]))
        except ValueError as error:
            where = " and ".join(map(self.numbers.key, names))
            raise FileError(f"{self._where}: {where}", str(error)) from error


def _maps(content: Any, above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """The mappings in a content with the keys above them; a lens keeps its groups."""
    if isinstance(content, dict):
        yield above, content
    children = content.items() if isinstance(content, dict) else enumerate(content)
    for key, value in children if len(above) < _DEEPEST else ():
        is_list = isinstance(value, list) and any(isinstance(each, dict) for each in value)
        is_map = isinstance(value, dict) and "data" not in value and not is_group(key)
        if is_list or is_map:
            yield from _maps(value, (*above, str(key)))
