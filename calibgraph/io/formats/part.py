"""What one file of others holds about a rig: lenses, extrinsics, and frames in their parents."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError
from calibgraph.io.formats.rig_export import frame_id
from calibgraph.io.lenses import CameraLens
from calibgraph.model.geometry import T_OPTICAL_LINK, invert
from calibgraph.model.rig import Mount

ONLY_CAMERA = ""
"""Stands for the camera of a file that names none: the only one of all files."""


@dataclass(frozen=True, eq=False)
class RelativeCamera:
    """A (4, 4) T_a_b between two cameras, in optical axes; its sigmas if the file has them."""

    a: str
    b: str
    T_a_b: Array
    rotation_sigma_rad: float | None = None
    translation_sigma_m: float | None = None


@dataclass(frozen=True, eq=False)
class FrameLink:
    """The (4, 4) pose of a child frame in its parent, as in TF and URDF; a note if it can move."""

    parent: str
    child: str
    T_parent_child: Array
    note: str = ""


@dataclass(frozen=True, eq=False)
class Part:
    """Lenses, extrinsics and frames of one file; any of them may be missing.

    Attributes:
        lenses: by camera.
        T_camera_lidar: (4, 4) by camera.
        relative_poses: between cameras, measured independently of T_camera_lidar.
        links: frames in their parents.
        frame_ids: of optical frames, by camera.
        mounts: the links of a tree by which cameras hang, by camera.
        lidar: the LiDAR's frame; None if the file does not name it.
        notes: what was assumed or left out, a line each.
    """

    path: Path
    lenses: Mapping[str, CameraLens] = field(default_factory=dict)
    T_camera_lidar: Mapping[str, Array] = field(default_factory=dict)
    relative_poses: tuple[RelativeCamera, ...] = ()
    links: tuple[FrameLink, ...] = ()
    frame_ids: Mapping[str, str] = field(default_factory=dict)
    mounts: Mapping[str, Mount] = field(default_factory=dict)
    lidar: str | None = None
    notes: tuple[str, ...] = ()

    @property
    def is_empty(self) -> bool:
        """Whether it holds no lens, no extrinsic and no frame."""
        return not (self.lenses or self.T_camera_lidar or self.links)

    def rename(self, names: Mapping[str, str]) -> Part:
        """The same with other names of some cameras; frames keep theirs."""
        return replace(
            self,
            lenses={names.get(name, name): lens for name, lens in self.lenses.items()},
            T_camera_lidar={names.get(name, name): T for name, T in self.T_camera_lidar.items()},
            relative_poses=tuple(
                replace(pair, a=names.get(pair.a, pair.a), b=names.get(pair.b, pair.b))
                for pair in self.relative_poses
            ),
            frame_ids={names.get(name, name): frame for name, frame in self.frame_ids.items()},
            mounts={names.get(name, name): mount for name, mount in self.mounts.items()},
        )


_LIDAR_WORDS = (
    "lidar", "velodyne", "ouster", "os_sensor", "hesai", "pandar", "livox", "rslidar", "robosense",
)  # fmt: skip
_CAMERA_FRAMES = (
    "{}_optical_frame", "{}_optical_link", "{}_optical", "{}/camera_optical_link",
    "{}_camera_optical_frame", "{}_color_optical_frame", "{}/camera_link", "{}_camera_link",
    "{}_link", "{}",
)  # fmt: skip
"""Frames of a camera, by its name; those that are not optical are x forward, y left, z up."""


class FrameTree:
    """Frames with the pose of each in its root.

    Raises:
        CalibrationError: if a frame has two parents, or is its own ancestor.
    """

    def __init__(self, links: Iterable[FrameLink]) -> None:
        self._links: dict[str, FrameLink] = {}
        for link in links:
            if link.child in self._links:
                raise CalibrationError(f"frame {link.child!r} has two parents; give one of them")
            self._links[link.child] = link
        self.parents = {child: link.parent for child, link in self._links.items()}
        self.names = tuple(sorted({*self.parents.values(), *self.parents}))

    def T_between(self, target: str, source: str) -> Array:
        """(4, 4) T_target_source.

        Raises:
            CalibrationError: if a frame is unknown, or the two are not connected.
        """
        target_root, T_root_target = self._in_root(target)
        source_root, T_root_source = self._in_root(source)
        if target_root != source_root:
            raise CalibrationError(
                f"frames {target!r} and {source!r} are not connected: their roots are "
                f"{target_root!r} and {source_root!r}; add the file with the transform between them"
            )
        T_target_source: Array = invert(T_root_target) @ T_root_source
        return T_target_source

    def notes_between(self, frame: str, other: str) -> list[str]:
        """The notes on the links between two frames."""
        above = [set(self._above(each)) for each in (frame, other)]
        return [note for each in sorted(above[0] ^ above[1]) if (note := self._links[each].note)]

    def _above(self, frame: str) -> Iterator[str]:
        """A frame and its ancestors but for the root."""
        passed: set[str] = set()
        while frame in self._links:
            if frame in passed:
                raise CalibrationError(f"frame {frame!r} is its own ancestor; correct the file")
            passed.add(frame)
            yield frame
            frame = self._links[frame].parent

    def _in_root(self, frame: str) -> tuple[str, Array]:
        """The root above a frame, and the (4, 4) pose of the frame in it."""
        if frame not in self.names:
            raise CalibrationError(f"no frame {frame!r}; there are {', '.join(self.names)}")
        T = np.eye(4)
        for each in self._above(frame):
            link = self._links[each]
            T, frame = link.T_parent_child @ T, link.parent
        return frame, T


def optical_axes(frame: str) -> Array:
    """(4, 4) from a camera's frame to its optical axes."""
    return np.eye(4) if is_optical(frame) else T_OPTICAL_LINK


def is_optical(frame: str) -> bool:
    """Whether a frame is x right, y down, z forward, by its name."""
    return "optical" in frame.lower()


def find_lidar_frame(tree: FrameTree) -> str:
    """The one frame with the name of a LiDAR."""
    found = [name for name in tree.names if any(word in name.lower() for word in _LIDAR_WORDS)]
    if len(found) != 1:
        what = f"could be {', '.join(found)}" if found else f"is none of {', '.join(tree.names)}"
        raise CalibrationError(f"the frame of the LiDAR {what} by name; name it with --lidar-frame")
    return found[0]


def find_camera_frame(tree: FrameTree, camera: str, chosen: Mapping[str, str]) -> str | None:
    """The chosen frame of a camera, else one with its name; None if there is none."""
    if camera in chosen:
        return chosen[camera]
    names = (pattern.format(frame_id(camera)) for pattern in _CAMERA_FRAMES)
    return next((name for name in names if name in tree.names), None)
