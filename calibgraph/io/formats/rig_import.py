"""A rig from the files of other programs."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError, FileError, RigError
from calibgraph.files import checked_model
from calibgraph.io.formats.part import (
    ONLY_CAMERA,
    FrameLink,
    FrameTree,
    Part,
    RelativeCamera,
    find_camera_frame,
    find_lidar_frame,
    optical_axes,
)
from calibgraph.io.formats.read_part import read_part
from calibgraph.io.lenses import CameraLens
from calibgraph.io.mounts import find_mounts
from calibgraph.model.geometry import invert
from calibgraph.model.rig import Mount, Rig

Value = TypeVar("Value")

RELATIVE_SIGMA_DEG = 0.1
RELATIVE_SIGMA_CM = 0.5
"""Assumed of relative poses whose file has none: a stereo calibration with a board, generously."""

_SAME = 1e-6  # of transforms that two files give: they may be rounded


def import_rig(
    files: Iterable[Path | str],
    *,
    names: Mapping[Path | str, str] | None = None,
    rename: Mapping[str, str] | None = None,
    lidar_frame: str | None = None,
    camera_frames: Mapping[str, str] | None = None,
    size_px: tuple[int, int] | None = None,
    relative_sigma_deg: float = RELATIVE_SIGMA_DEG,
    relative_sigma_cm: float = RELATIVE_SIGMA_CM,
) -> Rig:
    """Build a rig from files of other programs, which together hold lenses and extrinsics.

    Args:
        files: of the kinds in ``calibgraph.io.formats.names.IMPORT_FORMATS``.
        names: camera names for files of a single camera, by file.
        rename: new names of cameras, by those in the files.
        lidar_frame: the LiDAR's frame among those of the files; the one with such a name if None.
        camera_frames: per camera, its frame, where the names differ.
        size_px: width and height of images whose file has none.
        relative_sigma_deg: 1 sigma per axis of relative poses whose file has none.
        relative_sigma_cm: likewise of their translation.

    Raises:
        CalibrationError: if a file is malformed, a lens is none of ours, or something is missing.
    """
    parts = read_rig_parts(
        files, names=names, rename=rename, lidar_frame=lidar_frame, camera_frames=camera_frames
    )
    return parts.to_rig(
        size_px=size_px,
        relative_sigma_deg=relative_sigma_deg,
        relative_sigma_cm=relative_sigma_cm,
    )


@dataclass(frozen=True, eq=False)
class RigParts:
    """What files of other programs hold about a rig together; extrinsics may be missing.

    Attributes:
        lidar: name of the LiDAR.
        lenses: by camera.
        T_camera_lidar: (4, 4) of the cameras that have one.
        pairs: relative poses.
        frames: names of the frames.
        frame_ids: of optical frames, by camera.
        mounts: the links of a tree by which cameras hang, by camera.
        notes: what was assumed or left out in the files, a line each.
    """

    path: Path
    lidar: str
    lenses: Mapping[str, CameraLens]
    T_camera_lidar: Mapping[str, Array]
    pairs: Sequence[RelativeCamera]
    frames: Sequence[str]
    frame_ids: Mapping[str, str]
    mounts: Mapping[str, Mount]
    notes: Sequence[str]

    def tied_to(self, camera: str, T_camera_lidar: Array) -> dict[str, Array]:
        """(4, 4) T_camera_lidar of a camera, and of those that relative poses tie to it."""
        return _by_pairs({camera: T_camera_lidar}, self.pairs)

    def to_rig(
        self,
        extrinsics: Mapping[str, Array] | None = None,
        *,
        size_px: tuple[int, int] | None = None,
        relative_sigma_deg: float = RELATIVE_SIGMA_DEG,
        relative_sigma_cm: float = RELATIVE_SIGMA_CM,
    ) -> Rig:
        """The rig, with further (4, 4) T_camera_lidar, which replace the files'."""
        T = {**self.T_camera_lidar, **(extrinsics or {})}
        sigmas = (math.radians(relative_sigma_deg), relative_sigma_cm / 100.0)
        content: dict[str, Any] = {
            "lidar": self.lidar,
            "cameras": {
                name: {
                    **_camera(name, lens, T.get(name), size_px, parts=self),
                    "frame_id": self.frame_ids.get(name),
                    "mount": self.mounts.get(name),
                }
                for name, lens in self.lenses.items()
            },
            "relative_poses": [_relative_pose(pair, *sigmas) for pair in self.pairs],
        }
        return checked_model(Rig, content, self.path)


def read_rig_parts(
    files: Iterable[Path | str],
    *,
    names: Mapping[Path | str, str] | None = None,
    rename: Mapping[str, str] | None = None,
    lidar_frame: str | None = None,
    camera_frames: Mapping[str, str] | None = None,
) -> RigParts:
    """Read the files of a rig; arguments as of :func:`import_rig`.

    Raises:
        CalibrationError: if a file is malformed, or a lens is none of ours.
    """
    parts = _read_all(files, names or {}, rename or {})
    lenses = _merged(parts, lambda part: part.lenses, "lens", lambda one, other: one == other)
    T_camera_lidar = _merged(parts, lambda part: part.T_camera_lidar, "T_camera_lidar", _is_same)
    missing = sorted(lenses.keys() - T_camera_lidar.keys())
    links, notes = _later_first(parts)
    tree = FrameTree(links)
    frame_ids = {name: frame for part in parts for name, frame in part.frame_ids.items()}
    lidar = lidar_frame or next((part.lidar for part in parts if part.lidar), None)
    in_tree = {name: frame for name, frame in frame_ids.items() if frame in tree.names}
    chosen = {**in_tree, **(camera_frames or {})}
    of_tree = lidar if lidar_frame or lidar in tree.names else None
    notes += [note for part in parts for note in part.notes]
    try:
        by_frames, mounts = _by_frames(tree, missing, of_tree, chosen, notes=notes)
    except CalibrationError as error:
        raise CalibrationError("; ".join([str(error), *notes])) from error
    T_camera_lidar |= by_frames
    pairs = [pair for part in parts for pair in part.relative_poses]
    T_camera_lidar |= _by_pairs(T_camera_lidar, pairs)
    return RigParts(
        path=parts[0].path,
        lidar=lidar or "lidar",
        lenses=lenses,
        T_camera_lidar=T_camera_lidar,
        pairs=pairs,
        frames=tree.names,
        frame_ids=frame_ids,
        mounts={n: m for part in parts for n, m in part.mounts.items()} | mounts,
        notes=notes,
    )


def _read_all(
    files: Iterable[Path | str], names: Mapping[Path | str, str], rename: Mapping[str, str]
) -> list[Part]:
    """The parts; at least one has a lens."""
    chosen = {Path(file): name for file, name in names.items()}
    read = [read_part(Path(file), chosen.get(Path(file))) for file in files]
    lenses = sorted({name for part in read for name in part.lenses})
    if len(lenses) == 1:
        read = [part.rename({ONLY_CAMERA: lenses[0]}) for part in read]
    for part in read:
        if ONLY_CAMERA in part.T_camera_lidar and len(lenses) > 1:
            raise FileError(part.path, f"names no camera; there are {', '.join(lenses)}: give it "
                            "as NAME=FILE")  # fmt: skip
    known = {name for part in read for name in (*part.lenses, *part.T_camera_lidar)}
    if not any(part.lenses for part in read):
        raise CalibrationError(
            f"{', '.join(str(part.path) for part in read)}: no lens; add the file with the "
            "intrinsics (camera_info, camchain, ...)"
        )
    for name in sorted(rename.keys() - known):
        raise CalibrationError(
            f"no camera {name!r} to rename; the files have {', '.join(sorted(known))}"
        )
    after = {rename.get(name, name) for name in known}
    if len(after) < len(known):
        raise CalibrationError("--rename gives two cameras one name; give each its own")
    return [part.rename(rename) for part in read]


def _merged(
    parts: Iterable[Part],
    select: Callable[[Part], Mapping[str, Value]],
    what: str,
    is_same: Callable[[Value, Value], bool],
) -> dict[str, Value]:
    """What the parts hold, by camera."""
    merged: dict[str, Value] = {}
    for part in parts:
        for name, value in select(part).items():
            if not is_same(merged.setdefault(name, value), value):
                raise FileError(
                    part.path, f"has another {what} of camera {name!r} than a file before it; "
                    "leave one of them out"
                )  # fmt: skip
    return merged


def _is_same(one: Array, other: Array) -> bool:
    return bool(np.abs(one - other).max() <= _SAME)


def _later_first(parts: Sequence[Part]) -> tuple[list[FrameLink], list[str]]:
    """The links, of which a later file's replace those between the same frames; and notes."""
    links: list[FrameLink] = []
    notes: list[str] = []
    for part in parts:
        own = {(each.parent, each.child) for each in part.links}
        replaced = [each for each in links if (each.parent, each.child) in own]
        notes += [f"{part.path}: {e.child} in {e.parent} is that of this file" for e in replaced]
        links = [each for each in links if each not in replaced] + [*part.links]
    return links, notes


def _by_frames(
    tree: FrameTree,
    cameras: Iterable[str],
    lidar_frame: str | None,
    chosen: Mapping[str, str],
    *,
    notes: list[str],
) -> tuple[dict[str, Array], dict[str, Mount]]:
    """T_camera_lidar and mounts of the cameras that have a frame in the tree; notes on links."""
    frames = {name: find_camera_frame(tree, name, chosen) for name in cameras}
    found = {n: (frame, optical_axes(frame)) for n, frame in frames.items() if frame is not None}
    if not found:
        return {}, {}
    lidar = lidar_frame or find_lidar_frame(tree)
    for frame, _ in found.values():
        notes += [note for note in tree.notes_between(frame, lidar) if note not in notes]
    T = {name: axes @ tree.T_between(frame, lidar) for name, (frame, axes) in found.items()}
    return T, find_mounts(found, lidar, tree.parents, tree.T_between)


def _by_pairs(known: Mapping[str, Array], pairs: Iterable[RelativeCamera]) -> dict[str, Array]:
    """T_camera_lidar of the cameras that relative poses tie to one that is known."""
    found = dict(known)
    both_ways = [
        step
        for pair in pairs
        for step in ((pair.a, pair.b, invert(pair.T_a_b)), (pair.b, pair.a, pair.T_a_b))
    ]
    for _ in both_ways:  # as many passes as the longest chain may need
        for start, end, T_end_start in both_ways:
            if start in found and end not in found:
                found[end] = T_end_start @ found[start]
    return found


def _relative_pose(pair: RelativeCamera, sigma_rad: float, sigma_m: float) -> dict[str, Any]:
    return {
        "a": pair.a,
        "b": pair.b,
        "T_a_b": pair.T_a_b,
        "rotation_sigma_rad": pair.rotation_sigma_rad or sigma_rad,
        "translation_sigma_m": pair.translation_sigma_m or sigma_m,
    }


def _camera(
    name: str,
    lens: CameraLens,
    T_camera_lidar: Array | None,
    size_px: tuple[int, int] | None,
    *,
    parts: RigParts,
) -> dict[str, Any]:
    """The content of a rig file for a camera."""
    size = lens.size_px or size_px
    if size is None:
        raise RigError(
            f"camera {name!r}: its file has no image size; give it with --size WIDTHxHEIGHT",
            camera=name,
        )
    if T_camera_lidar is None:
        listed = f" (its frames are {', '.join(parts.frames)})" if parts.frames else ""
        notes = "".join(f"; {note}" for note in parts.notes)
        raise RigError(
            f"camera {name!r}: no file has its T_camera_lidar{listed}; name its "
            "frame with --camera-frame, add a URDF, a sensor kit or a rig file with a guess, or "
            f"describe its mounting with --mount {name}=WORDS{notes}",
            camera=name,
        )
    return {**replace(lens, size_px=size).fields(), "T_camera_lidar": T_camera_lidar}
