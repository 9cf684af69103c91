"""What files or a bag hold about a rig: lenses, extrinsics, trees of frames; and the rig of it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from shlex import quote
from typing import Any, NamedTuple

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.errors import DatasetError, FileError, RigError
from calibgraph.files import checked_model
from calibgraph.io.lenses import CameraLens
from calibgraph.model.geometry import invert, transform
from calibgraph.model.rig import ROUNDING, Mount, RelativePose, Rig

_TURN_RAD = 2 * math.pi + ROUNDING


class IncompleteCamera(FileError):
    """A camera without its lens, its pose or its images; what is there but wrong is no such."""


def quaternion_xyzw(T: Array) -> list[float]:
    """[x, y, z, w] of the rotation of a (4, 4), w not negative."""
    found = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
    return [float(value) for value in found]


def roll_pitch_yaw(T: Array) -> list[float]:
    """[roll, pitch, yaw] [rad] about fixed x, y, z: R = Rz(yaw) Ry(pitch) Rx(roll), as in URDF."""
    return [float(value) for value in gtsam.Rot3(T[:3, :3]).rpy()]


def pose_of_quaternion(xyz_m: Sequence[float], xyzw: Sequence[float]) -> Array:
    """(4, 4) of a translation and a quaternion of length 1, up to rounded digits."""
    length = math.hypot(*xyzw)
    if not abs(length - 1.0) <= ROUNDING:
        raise ValueError(f"quaternion {list(xyzw)} has length {length:.3g}, expected 1")
    return transform(Rotation.from_quat(xyzw).as_matrix(), xyz_m)


def pose_of_angles(xyz_m: Sequence[float], rpy_rad: Sequence[float]) -> Array:
    """(4, 4) of a translation and roll, pitch, yaw about fixed axes.

    Raises:
        ValueError: if an angle is beyond a turn: of degrees, most are.
    """
    roll, pitch, yaw = rpy_rad
    if max(map(abs, rpy_rad)) > _TURN_RAD:
        raise ValueError(
            f"roll, pitch, yaw are {roll:g}, {pitch:g}, {yaw:g} rad, beyond 2 pi: are they in "
            "degrees? give radians, 90 deg is 1.5708"
        )
    return transform(gtsam.Rot3.RzRyRx(roll, pitch, yaw).matrix(), xyz_m)


class Link(NamedTuple):
    """The (4, 4) pose of a child frame in its parent; a note if it can move, or on its source."""

    parent: str
    child: str
    T_parent_child: Array
    note: str = ""


Links = Mapping[str, Link]
"""By child frame."""


def ancestors(links: Links, frame: str) -> dict[str, Array]:
    """(4, 4) T_ancestor_frame of the frame itself and all above it, nearest first."""
    found, T, above = {frame: np.eye(4)}, np.eye(4), frame
    while above in links and links[above].parent not in found:
        T = links[above].T_parent_child @ T
        above = links[above].parent
        found[above] = T
    return found


def T_between(links: Links, target: str, source: str) -> Array | None:
    """(4, 4) T_target_source through the frame that both hang from; None if there is none."""
    above_target, above_source = ancestors(links, target), ancestors(links, source)
    for frame, T_frame_target in above_target.items():
        if frame in above_source:
            T_target_source: Array = invert(T_frame_target) @ above_source[frame]
            return T_target_source
    return None


def links_between(links: Links, frame: str, other: str) -> list[Link]:
    """The links of the way between two frames that are connected."""
    way = ancestors(links, frame).keys() ^ ancestors(links, other).keys()
    return [links[each] for each in sorted(way)]


def find_mounts(
    cameras: Mapping[str, tuple[str, Array]], lidar: str, links: Links
) -> dict[str, Mount]:
    """The mounts of cameras. A camera below the LiDAR itself, or that shares all links, has none.

    ``cameras`` are, by name, the frame in the tree, and (4, 4) T_camera_frame from it.
    """
    above = {name: ancestors(links, frame) for name, (frame, _) in cameras.items()}
    above_lidar = ancestors(links, lidar)
    found = {}
    for name, (frame, T_camera_frame) in cameras.items():
        others = {each for other, way in above.items() if other != name for each in way}
        own = [each for each in above[name] if each in links and each not in others
               and each not in above_lidar]  # fmt: skip
        if not own or links[own[-1]][:2] == (lidar, frame):
            continue
        child, parent = own[-1], links[own[-1]].parent
        T_parent_lidar = T_between(links, parent, lidar)
        if T_parent_lidar is not None:
            T_camera_child = T_camera_frame @ invert(above[name][child])
            found[name] = Mount(
                parent=parent, child=child, T_parent_lidar=T_parent_lidar,
                T_camera_child=T_camera_child,
            )  # fmt: skip
    return found


ONLY_CAMERA = ""
"""The name of a camera whose file states none; there is only one such camera."""

_RELATIVE_SIGMAS = math.radians(0.1), 0.005
"""Assumed of relative poses whose file has none: a stereo calibration with a board, generously."""


def relative_pose(a: str, b: str, T_a_b: Array) -> RelativePose:
    """A pose between two cameras, in optical axes, of a file that has no sigmas of it."""
    rotation, translation = _RELATIVE_SIGMAS
    return RelativePose(
        a=a, b=b, T_a_b=T_a_b, rotation_sigma_rad=rotation, translation_sigma_m=translation
    )


@dataclass(frozen=True, eq=False)
class RigParts:
    """Lenses, extrinsics and frames of a file, of several, or of a bag; any may be missing.

    Attributes:
        lenses: by camera.
        T_camera_lidar: (4, 4) by camera.
        relative_poses: between cameras, measured independently of T_camera_lidar.
        links: frames in their parents.
        frame_ids: of optical frames, by camera.
        mounts: the links of a tree by which cameras hang, by camera.
        lidar: the LiDAR's frame; None if the file does not name it.
        notes: what was assumed or left out, a line each.
        why_missing: by camera of a bag without T_camera_lidar, the error.
    """

    path: Path
    lenses: Mapping[str, CameraLens] = field(default_factory=dict)
    T_camera_lidar: Mapping[str, Array] = field(default_factory=dict)
    relative_poses: tuple[RelativePose, ...] = ()
    links: tuple[Link, ...] = ()
    frame_ids: Mapping[str, str] = field(default_factory=dict)
    mounts: Mapping[str, Mount] = field(default_factory=dict)
    lidar: str | None = None
    notes: tuple[str, ...] = ()
    why_missing: Mapping[str, str] = field(default_factory=dict)

    @property
    def is_empty(self) -> bool:
        """Whether it holds no lens, no extrinsic and no frame."""
        return not (self.lenses or self.T_camera_lidar or self.links)

    def rename(self, names: Mapping[str, str]) -> RigParts:
        """The same with other names of some cameras; frames keep theirs."""
        by_camera = ("lenses", "T_camera_lidar", "frame_ids", "mounts")
        named: dict[str, Any] = {
            part: {names.get(name, name): value for name, value in getattr(self, part).items()}
            for part in by_camera
        }
        pairs = (
            pair.model_copy(update={"a": names.get(pair.a, pair.a), "b": names.get(pair.b, pair.b)})
            for pair in self.relative_poses
        )
        return replace(self, **named, relative_poses=tuple(pairs))

    def tied_to(self, known: Mapping[str, Array]) -> dict[str, Array]:
        """(4, 4) T_camera_lidar per camera: known, or found from a known one by relative poses."""
        found = dict(known)
        both_ways = [
            step
            for pair in self.relative_poses
            for step in ((pair.a, pair.b, invert(pair.T_a_b)), (pair.b, pair.a, pair.T_a_b))
        ]
        for _ in both_ways:  # as many passes as the longest chain may need
            for start, end, T_end_start in both_ways:
                if start in found and end not in found:
                    found[end] = T_end_start @ found[start]
        return found

    def to_rig(
        self,
        extrinsics: Mapping[str, Array] | None = None,
        *,
        size_px: tuple[int, int] | None = None,
    ) -> Rig:
        """The rig, with further (4, 4) T_camera_lidar, which replace the files'."""
        T = {**self.T_camera_lidar, **(extrinsics or {})}
        content: dict[str, Any] = {
            "lidar": self.lidar,
            "cameras": {
                name: {
                    **replace(lens, size_px=self._size_px(name, lens.size_px or size_px)).fields(),
                    "T_camera_lidar": T[name] if name in T else self._missing(name),
                    "frame_id": self.frame_ids.get(name),
                    "mount": self.mounts.get(name),
                }
                for name, lens in self.lenses.items()
            },
            "relative_poses": self.relative_poses,
        }
        return checked_model(Rig, content, self.path)

    def _size_px(self, name: str, size_px: tuple[int, int] | None) -> tuple[int, int]:
        if size_px is None:
            raise RigError(
                f"camera {name!r}: its file has no image size; give it with --size WIDTHxHEIGHT",
                camera=name,
            )
        return size_px

    def _missing(self, name: str) -> Array:
        """Raise that a camera has no extrinsic."""
        if name in self.why_missing:
            raise DatasetError(self.why_missing[name], camera=name)
        frames = frame_names(self.links)
        listed = f" (its frames are {', '.join(frames)})" if frames else ""
        notes = "".join(f"; {note}" for note in self.notes)
        raise RigError(
            f"camera {name!r}: no file has its T_camera_lidar{listed}; name its "
            "frame with --camera-frame, add a URDF, a sensor kit or a rig file with a guess, or "
            f"describe its mounting with --mount {quote(name)}=WORDS{notes}",
            camera=name,
        )


def frame_names(links: Iterable[Link]) -> list[str]:
    """The frames of links."""
    return sorted({name for link in links for name in link[:2]})


def frame_id(name: str) -> str:
    """A name as ROS frame id: other characters than letters, digits, _ / . - become _."""
    return re.sub(r"[^\w/.-]", "_", name)
