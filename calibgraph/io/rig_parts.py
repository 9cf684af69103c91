"""What files or a bag hold about a rig: lenses, extrinsics, frames; and the rig of it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from shlex import quote
from typing import Any

from calibgraph.arrays import Array
from calibgraph.errors import DatasetError, RigError
from calibgraph.files import checked_model
from calibgraph.io.frame_tree import Link
from calibgraph.io.lenses import CameraLens
from calibgraph.model.geometry import invert
from calibgraph.model.rig import Mount, Rig

ONLY_CAMERA = ""
"""The name of a camera whose file states none; there is only one such camera."""

RELATIVE_SIGMA_DEG = 0.1
RELATIVE_SIGMA_CM = 0.5
"""Assumed of relative poses whose file has none: a stereo calibration with a board, generously."""


@dataclass(frozen=True, eq=False)
class RelativeCamera:
    """A (4, 4) T_a_b between two cameras, in optical axes; its sigmas if the file has them."""

    a: str
    b: str
    T_a_b: Array
    rotation_sigma_rad: float | None = None
    translation_sigma_m: float | None = None


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
        why_untied: why the cameras' relative poses cannot be taken as measured; empty if they can.
    """

    path: Path
    lenses: Mapping[str, CameraLens] = field(default_factory=dict)
    T_camera_lidar: Mapping[str, Array] = field(default_factory=dict)
    relative_poses: tuple[RelativeCamera, ...] = ()
    links: tuple[Link, ...] = ()
    frame_ids: Mapping[str, str] = field(default_factory=dict)
    mounts: Mapping[str, Mount] = field(default_factory=dict)
    lidar: str | None = None
    notes: tuple[str, ...] = ()
    why_missing: Mapping[str, str] = field(default_factory=dict)
    why_untied: str = ""

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
            replace(pair, a=names.get(pair.a, pair.a), b=names.get(pair.b, pair.b))
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
        relative_sigma_deg: float = RELATIVE_SIGMA_DEG,
        relative_sigma_cm: float = RELATIVE_SIGMA_CM,
    ) -> Rig:
        """The rig, with further (4, 4) T_camera_lidar, which replace the files'.

        Raises:
            RigError, DatasetError: if a size or an extrinsic is missing.
            FileError: if a value is no camera's.
        """
        T = {**self.T_camera_lidar, **(extrinsics or {})}
        sigmas = math.radians(relative_sigma_deg), relative_sigma_cm / 100.0
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
            "relative_poses": [
                {
                    "a": pair.a,
                    "b": pair.b,
                    "T_a_b": pair.T_a_b,
                    "rotation_sigma_rad": pair.rotation_sigma_rad or sigmas[0],
                    "translation_sigma_m": pair.translation_sigma_m or sigmas[1],
                }
                for pair in self.relative_poses
            ],
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
