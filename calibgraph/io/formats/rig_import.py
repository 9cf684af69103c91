"""A rig from the files of other programs."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError, FileError
from calibgraph.io.formats.read_part import read_part
from calibgraph.io.formats.rig_export import frame_id
from calibgraph.io.frame_tree import (
    Link,
    Links,
    T_between,
    ancestors,
    find_mounts,
    links_between,
)
from calibgraph.io.rig_parts import (
    ONLY_CAMERA,
    RELATIVE_SIGMA_CM,
    RELATIVE_SIGMA_DEG,
    RigParts,
    frame_names,
)
from calibgraph.model.geometry import T_OPTICAL_LINK
from calibgraph.model.rig import Mount, Rig

Value = TypeVar("Value")

_SAME = 1e-6  # of transforms that two files give: they may be rounded
_LIDAR_WORDS = (
    "lidar", "velodyne", "ouster", "os_sensor", "hesai", "pandar", "livox", "rslidar", "robosense",
)  # fmt: skip
_CAMERA_FRAMES = (
    "{}_optical_frame", "{}_optical_link", "{}_optical", "{}/camera_optical_link",
    "{}_camera_optical_frame", "{}_color_optical_frame", "{}/camera_link", "{}_camera_link",
    "{}_link", "{}",
)  # fmt: skip
"""Frames of a camera, by its name; those that are not optical are x forward, y left, z up."""


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
    links, notes = _later_first(parts)
    tree = _tree(links)
    frame_ids = {name: frame for part in parts for name, frame in part.frame_ids.items()}
    lidar = lidar_frame or next((part.lidar for part in parts if part.lidar), None)
    known = frame_names(links)
    in_tree = {name: frame for name, frame in frame_ids.items() if frame in known}
    notes += [note for part in parts for note in part.notes]
    try:
        by_frames, mounts = _by_frames(
            tree,
            sorted(lenses.keys() - T_camera_lidar.keys()),
            lidar if lidar_frame or lidar in known else None,
            {**in_tree, **(camera_frames or {})},
            notes=notes,
        )
    except CalibrationError as error:
        raise CalibrationError("; ".join([str(error), *notes])) from error
    found = RigParts(
        parts[0].path,
        lenses,
        relative_poses=tuple(pair for part in parts for pair in part.relative_poses),
        links=tuple(links),
        frame_ids=frame_ids,
        mounts={n: m for part in parts for n, m in part.mounts.items()} | mounts,
        lidar=lidar or "lidar",
        notes=tuple(notes),
    )
    return replace(found, T_camera_lidar=found.tied_to(T_camera_lidar | by_frames))


def _read_all(
    files: Iterable[Path | str], names: Mapping[Path | str, str], rename: Mapping[str, str]
) -> list[RigParts]:
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
    parts: Iterable[RigParts],
    select: Callable[[RigParts], Mapping[str, Value]],
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


def _later_first(parts: Sequence[RigParts]) -> tuple[list[Link], list[str]]:
    """The links, of which a later file's replace those between the same frames; and notes."""
    links: list[Link] = []
    notes: list[str] = []
    for part in parts:
        own = {each[:2] for each in part.links}
        replaced = [each for each in links if each[:2] in own]
        notes += [f"{part.path}: {e.child} in {e.parent} is that of this file" for e in replaced]
        links = [each for each in links if each[:2] not in own] + [*part.links]
    return links, notes


def _tree(links: Iterable[Link]) -> dict[str, Link]:
    """The links by child; each frame has one parent, and is not its own ancestor."""
    tree: dict[str, Link] = {}
    for link in links:
        if link.child in tree:
            raise CalibrationError(f"frame {link.child!r} has two parents; give one of them")
        tree[link.child] = link
    for frame in tree:
        *_, top = ancestors(tree, frame)
        if top in tree:
            raise CalibrationError(f"frame {frame!r} is its own ancestor; correct the file")
    return tree


def _by_frames(
    tree: Links,
    cameras: Iterable[str],
    lidar_frame: str | None,
    chosen: Mapping[str, str],
    *,
    notes: list[str],
) -> tuple[dict[str, Array], dict[str, Mount]]:
    """T_camera_lidar and mounts of the cameras that have a frame in the tree; notes on links."""
    names = frame_names(tree.values())
    frames = {name: _find_camera_frame(names, name, chosen) for name in cameras}
    found = {
        name: (frame, np.eye(4) if "optical" in frame.lower() else T_OPTICAL_LINK)
        for name, frame in frames.items()
        if frame is not None
    }
    if not found:
        return {}, {}
    lidar = lidar_frame or _find_lidar_frame(names)
    T = {name: axes @ _T_between(tree, frame, lidar) for name, (frame, axes) in found.items()}
    for frame, _ in found.values():
        between = (link.note for link in links_between(tree, frame, lidar))
        notes += [note for note in between if note and note not in notes]
    return T, find_mounts(found, lidar, tree)


def _T_between(tree: Links, target: str, source: str) -> Array:
    """(4, 4) T_target_source of two frames."""
    names = frame_names(tree.values())
    for frame in (target, source):
        if frame not in names:
            raise CalibrationError(f"no frame {frame!r}; there are {', '.join(names)}")
    T = T_between(tree, target, source)
    if T is None:
        roots = " and ".join(repr([*ancestors(tree, frame)][-1]) for frame in (target, source))
        raise CalibrationError(
            f"frames {target!r} and {source!r} are not connected: their roots are {roots}; add "
            "the file with the transform between them"
        )
    return T


def _find_lidar_frame(names: Sequence[str]) -> str:
    """The one frame with the name of a LiDAR."""
    found = [name for name in names if any(word in name.lower() for word in _LIDAR_WORDS)]
    if len(found) != 1:
        what = f"could be {', '.join(found)}" if found else f"is none of {', '.join(names)}"
        raise CalibrationError(f"the frame of the LiDAR {what} by name; name it with --lidar-frame")
    return found[0]


def _find_camera_frame(names: Sequence[str], camera: str, chosen: Mapping[str, str]) -> str | None:
    """The chosen frame of a camera, else one with its name; None if there is none."""
    if camera in chosen:
        return chosen[camera]
    likely = (pattern.format(frame_id(camera)) for pattern in _CAMERA_FRAMES)
    return next((name for name in likely if name in names), None)
