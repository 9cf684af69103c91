"""What one file of others holds about a rig."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from calibgraph.arrays import Array
from calibgraph.io.formats.rig_export import frame_id
from calibgraph.io.lenses import CameraLens

ONLY_CAMERA = ""
"""Stands for the camera of a file that names none: the only one of all files."""

IMU = "imu"
"""The frame of the IMU in files that give poses in it."""


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
    """The (4, 4) pose of a child frame in its parent, as in TF and URDF."""

    parent: str
    child: str
    T_parent_child: Array


@dataclass(frozen=True, eq=False)
class Part:
    """Lenses, extrinsics and frames of one file; any of them may be missing.

    Attributes:
        path: of the file.
        lenses: by camera.
        T_camera_lidar: (4, 4) by camera.
        relative_poses: between cameras, measured independently of T_camera_lidar.
        links: frames in their parents.
        frame_ids: of optical frames, by camera.
        lidar: the LiDAR's frame; None if the file does not name it.
        notes: what was assumed or left out, a line each.
    """

    path: Path
    lenses: Mapping[str, CameraLens] = field(default_factory=dict)
    T_camera_lidar: Mapping[str, Array] = field(default_factory=dict)
    relative_poses: tuple[RelativeCamera, ...] = ()
    links: tuple[FrameLink, ...] = ()
    frame_ids: Mapping[str, str] = field(default_factory=dict)
    lidar: str | None = None
    notes: tuple[str, ...] = ()

    @property
    def is_empty(self) -> bool:
        """Whether it holds no lens, no extrinsic and no frame."""
        return not (self.lenses or self.T_camera_lidar or self.links)

    def rename(self, names: Mapping[str, str]) -> Part:
        """The same with other names of some cameras; frames keep theirs, but for ONLY_CAMERA's."""
        only = frame_id(names.get(ONLY_CAMERA, ONLY_CAMERA))
        frames = {f"_{axes}": f"{only}_{axes}" for axes in ("optical", "optical_frame")}
        return replace(
            self,
            lenses={names.get(name, name): lens for name, lens in self.lenses.items()},
            T_camera_lidar={names.get(name, name): T for name, T in self.T_camera_lidar.items()},
            relative_poses=tuple(
                replace(pair, a=names.get(pair.a, pair.a), b=names.get(pair.b, pair.b))
                for pair in self.relative_poses
            ),
            links=tuple(
                replace(
                    link,
                    parent=frames.get(link.parent, link.parent),
                    child=frames.get(link.child, link.child),
                )
                for link in self.links
            ),
            frame_ids={
                names.get(name, name): frames.get(frame, frame)
                for name, frame in self.frame_ids.items()
            },
        )
