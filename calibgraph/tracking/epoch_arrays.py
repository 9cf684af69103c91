"""An epoch as a few arrays, as it is kept on disk, and back: its frames have hundreds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.solver.matches import CameraBlock
from calibgraph.tracking.live_frames import Epoch, LiveFrame
from calibgraph.tracking.sums import Sums
from factors import ProjectionBlock

Columns = tuple[tuple[bool, ...], NDArray[Any] | None]
"""Which frames have a column, and the rows of these under each other."""


def to_arrays(epoch: Epoch) -> dict[str, Any]:
    """The fields of an epoch; the matches of a camera in all frames are under each other."""
    frames = epoch.frames
    return {
        "T_lidar_camera": epoch.T_lidar_camera,
        "distortion": epoch.distortion,
        "numbers": tuple(frame.number for frame in frames),
        "places": tuple(frame.place for frame in frames),
        "sums": np.array([frame.sums.packed for frame in frames]),
        "cameras": {
            camera: _matches(frames, camera) for camera in range(len(epoch.T_lidar_camera))
        },
    }


def from_arrays(held: dict[str, Any]) -> Epoch:
    """The epoch of which :func:`to_arrays` has made arrays."""
    numbers, fields = held["numbers"], (held["T_lidar_camera"], held["distortion"])
    blocks = [dict[int, CameraBlock]() for _ in numbers]
    inliers = [dict[int, NDArray[np.bool_]]() for _ in numbers]
    for camera, matches in held["cameras"].items():
        for row, block, within in _blocks(matches, numbers):
            blocks[row][camera], inliers[row][camera] = block, within
    sums = map(Sums, held["sums"])
    rows = zip(numbers, blocks, inliers, sums, held["places"], strict=True)
    return Epoch(tuple(LiveFrame(*row) for row in rows), *fields)


def _matches(frames: Sequence[LiveFrame], camera: int) -> dict[str, Any]:
    """A camera's matches in the frames that have some; lens and loss are those of its rig."""
    rows = tuple(row for row, frame in enumerate(frames) if camera in frame.raw)
    if not rows:
        return {"rows": ()}
    own = [frames[row].raw[camera] for row in rows]
    blocks = [each.block for each in own]
    return {
        "rows": rows,
        "counts": tuple(map(len, own)),
        "lens": blocks[0].lens,
        "loss": blocks[0].loss,
        "points_lidar_m": np.concatenate([block.points_lidar_m for block in blocks]),
        "pixels_px": np.concatenate([block.pixels_px for block in blocks]),
        "sqrt_information": _joined([block.sqrt_information for block in blocks]),
        "motion": _joined([block.motion for block in blocks]),
        "information": _joined([each.information for each in own]),
        "inliers": np.concatenate([frames[row].inliers[camera] for row in rows]),
    }


def _blocks(
    held: dict[str, Any], numbers: Sequence[int]
) -> list[tuple[int, CameraBlock, NDArray[np.bool_]]]:
    """The frames' places in the epoch, their matches, and which of them are within the gate."""
    if not held["rows"]:
        return []
    edges = np.cumsum(held["counts"])[:-1]
    whole = (np.split(held[name], edges) for name in ("points_lidar_m", "pixels_px", "inliers"))
    optional = (
        _split(held[name], held["counts"]) for name in ("sqrt_information", "motion", "information")
    )
    found = []
    for row, points, pixels, inliers, root, motion, information in zip(
        held["rows"], *whole, *optional, strict=True
    ):
        block = ProjectionBlock(held["lens"], points, pixels, root, held["loss"], motion=motion)
        frame = np.full(len(points), numbers[row], np.int64)
        found.append((row, CameraBlock(block, information, frame), inliers))
    return found


def _joined(parts: Sequence[NDArray[Any] | None]) -> Columns:
    known = [part for part in parts if part is not None]
    return tuple(part is not None for part in parts), np.concatenate(known) if known else None


def _split(columns: Columns, counts: Sequence[int]) -> list[NDArray[Any] | None]:
    known, rows = columns
    if rows is None:
        return [None] * len(counts)
    edges = np.cumsum(np.where(known, counts, 0))[:-1]
    parts = zip(known, np.split(rows, edges), strict=True)
    return [part if is_known else None for is_known, part in parts]
