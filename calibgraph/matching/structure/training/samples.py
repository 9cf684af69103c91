"""What the windows of a camera score near its trusted pose, and by chance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.io.frame import Frame
from calibgraph.matching.structure.frame_cache import FrameCache
from calibgraph.matching.structure.peaks import PEAK_STEPS
from calibgraph.matching.structure.schedule import LEVELS
from calibgraph.matching.structure.score_kernel import score_windows
from calibgraph.matching.structure.shift_scores import ViewedWindows, view_windows
from calibgraph.matching.structure.windows import Windows
from calibgraph.model.clock import clock_of
from calibgraph.model.rig import Camera
from calibgraph.solver.camera_twist import project_with_jacobian
from factors import displace

Floats = NDArray[np.float32]

LEVEL = replace(LEVELS[-1], weighed=False)
NEAR = PEAK_STEPS + 1  # steps to each side of the truth: a peak and its neighbours
SIDE = 2 * NEAR + 1
REACH, CHANCE_SHIFTS = 10, 24
"""Steps to each side, and how many of the farther shifts show what windows score by chance."""


@dataclass(frozen=True, eq=False)
class CameraWindows:
    """The windows of a camera in some frames, by groups of one direction and depth.

    Attributes:
        camera: at its trusted pose.
        features: (w, f) see ``window_kernels.FEATURES``.
        near: (w, SIDE, SIDE) scores by shift [v, u] from the truth, which is in the middle.
        chance: (w, CHANCE_SHIFTS) scores at unrelated shifts.
        group: (w,) its group.
        points_lidar_m: (g, 3) mean point of each group, where it is when its pixel is taken.
        pixels_px: (g, 2) where it projects.
        steps_per_px: (2,) of u and v.
    """

    camera: Camera
    features: Floats
    near: Floats
    chance: Floats
    group: NDArray[np.int64]
    points_lidar_m: Array
    pixels_px: Array
    steps_per_px: Array


def camera_windows(
    frames: Sequence[Frame], name: str, camera: Camera, *, per_frame: int, cache: FrameCache
) -> CameraWindows | None:
    """The windows of a camera at its trusted pose; None if no group is in view.

    Args:
        frames: those with an image of the camera.
        name: of the camera.
        camera: lens and trusted pose.
        per_frame: most windows of a frame.
        cache: of clouds and images.
    """
    parts = [_of_frame(frame, name, camera, cache=cache, most=per_frame) for frame in frames]
    parts = [part for part in parts if len(part.points_lidar_m)]
    if not parts:
        return None
    firsts = np.cumsum([0, *(len(part.points_lidar_m) for part in parts)])
    groups = [part.group + first for part, first in zip(parts, firsts, strict=False)]

    def stack(name: str) -> Any:
        return np.concatenate([getattr(part, name) for part in parts])

    return CameraWindows(
        camera, stack("features"), stack("near"), stack("chance"), np.concatenate(groups),
        stack("points_lidar_m"), stack("pixels_px"), parts[0].steps_per_px,
    )  # fmt: skip


def _of_frame(
    frame: Frame, name: str, camera: Camera, *, cache: FrameCache, most: int
) -> CameraWindows:
    gray, cloud, twist = cache.image(frame, name, camera), cache.cloud(frame), frame.twist_per_s
    seen = view_windows(gray, cloud, camera, LEVEL, max_windows=most, twist_per_s=twist)
    near, chance = _score(seen)
    points = seen.seen_lidar_m
    if twist is not None:
        points = displace(points, twist, -clock_of(camera).offset_s)
    return CameraWindows(
        camera, seen.windows.features, near, chance, seen.group.astype(np.int64), points,
        project_with_jacobian(camera, points)[0], seen.steps_per_px,
    )  # fmt: skip


def _score(seen: ViewedWindows) -> tuple[Floats, Floats]:
    """Scores of every window by itself, near the truth and at unrelated shifts."""
    grids = score_each(seen.image, seen.places, seen.windows, REACH)
    middle, flat = slice(REACH - NEAR, REACH + NEAR + 1), (len(grids), (2 * REACH + 1) ** 2)
    return grids[:, middle, middle], grids.reshape(flat)[:, _unrelated()]


def score_each(image: Floats, places: NDArray[np.int32], windows: Windows, reach: int) -> Floats:
    """(w, s, s) scores of every window by itself, by shift [v, u] up to a reach in steps."""
    count, side = len(windows.counts), 2 * reach + 1
    grids = np.zeros((count, side, side), np.float32)
    group, first = np.arange(count, dtype=np.int32), np.array([-reach, -reach])
    score_windows(image, places, windows.counts, windows.basis, group, first, True, grids)
    return grids


def _unrelated() -> NDArray[np.int64]:
    """(CHANCE_SHIFTS,) cells of a grid beyond the near ones, always the same."""
    steps = np.abs(np.arange(-REACH, REACH + 1))
    far = np.flatnonzero(np.maximum(steps[:, None], steps) > NEAR)
    return np.random.default_rng(0).choice(far, CHANCE_SHIFTS, replace=False)
