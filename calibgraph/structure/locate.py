"""From where the rounds begin: the guess if it is near enough, or what a global search finds.

A pose is accepted when image and cloud agree at it far better than by chance. Each camera is tried
at the guess first, then wherever the cameras found so far put it, then all over the range, as often
as is useful. What is not accepted is not found: the best of the bad is never good enough.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from calibgraph.augmented import moved_by
from calibgraph.rig import Camera, Rig, angle_deg
from calibgraph.structure.consensus import find_consensus
from calibgraph.structure.level import LEVELS
from calibgraph.structure.responses import respond
from calibgraph.structure.scores import joined, score_frame
from calibgraph.structure.search import Box, search_box
from calibgraph.structure.windows import Cloud

Array = NDArray[np.float64]
Report = Callable[[str, int, int], None]

ACCEPTED = 16.0
"""Least contrast after the last of the levels. On recorded scenes within 20 deg and 1.5 m of the
guess, wrong poses had up to 15, right ones mostly from 17 on."""

ACCEPTED_NEAR, CLEARER = 8.0, 1.3
"""Least contrast near the guess, if the search finds only the same, or nothing near it in
contrast."""

SAME_DEG, SAME_M = 0.5, 0.15

HOPELESS = 7.5  # of any level: no right pose had less than 11 after the first
SETTLING = (
    (replace(LEVELS[0], translation_m=0.5), 6_000),
    (replace(LEVELS[1], translation_m=0.5), 20_000),
    (replace(LEVELS[2], translation_m=0.3), 20_000),
)
"""Levels, and how many windows they take, per camera over all frames. They look farther than the
rounds: a search is good to about a degree and some decimetres."""

SEARCH_WINDOWS = 300  # per frame
SEARCHES = 3


@dataclass(frozen=True, eq=False)
class View:
    """What a camera and the LiDAR saw in a few frames.

    Attributes:
        grays: (height, width) images.
        clouds: one per image.
    """

    grays: Sequence[NDArray[np.uint8]]
    clouds: Sequence[Cloud]


@dataclass(frozen=True, eq=False)
class Range:
    """How far from the guess to search, per axis."""

    rotation_rad: float
    translation_m: float


@dataclass(frozen=True, eq=False)
class Found:
    """Where a camera was found.

    Attributes:
        camera: at its pose.
        contrast: of image and cloud there, in chance spreads.
        accepted: whether that is enough.
    """

    camera: Camera
    contrast: float
    accepted: bool


def locate(
    rig: Rig,
    views: Mapping[str, View],
    within: Range,
    *,
    seed: int,
    out_of_time: Callable[[], bool],
    pool: ThreadPoolExecutor,
    progress: Report,
) -> dict[str, Found]:
    """Find all cameras of a rig.

    Args:
        rig: lenses, the guess, and relative poses if known.
        views: by the names of the cameras.
        within: where to search what is not near the guess.
        seed: of the search.
        out_of_time: asked before each search.
        pool: where cameras are worked on side by side.
        progress: to be told how far it is.
    """
    names = list(rig.cameras)
    progress("trying the guess", 0, SEARCHES + 1)
    tried = pool.map(lambda name: settle(views[name], rig.cameras[name]), names)
    near = dict(zip(names, tried, strict=True))
    far: dict[str, Found] = {}
    for attempt in range(SEARCHES):
        accepted = {n: f for found in (near, far) for n, f in found.items() if f.accepted}
        missing = [name for name in names if name not in accepted]
        if not missing or out_of_time():
            break
        progress(f"searching: {', '.join(missing)}", attempt + 1, SEARCHES + 1)
        one = partial(_search, rig, views, accepted, within, seed=seed + 1000 * attempt)
        for name, found in zip(missing, pool.map(one, missing), strict=True):
            far[name] = max(found, far.get(name, found), key=lambda f: f.contrast)
    return {name: _judged(near[name], far.get(name)) for name in names}


def settle(view: View, camera: Camera) -> Found:
    """Follow the agreement of a view from a camera's pose, until it stands still or is hopeless."""
    contrast = 0.0
    for level, windows in SETTLING:
        one = [
            score_frame(gray, cloud, camera, level, frame=i, most=windows // len(view.grays))
            for i, (gray, cloud) in enumerate(zip(view.grays, view.clouds, strict=True))
        ]
        twist, contrast = find_consensus(joined(one), level, seed=0)
        camera = moved_by(camera, twist)
        if contrast < HOPELESS:
            break
    return Found(camera, contrast, contrast >= ACCEPTED)


def _search(
    rig: Rig,
    views: Mapping[str, View],
    accepted: Mapping[str, Found],
    within: Range,
    name: str,
    *,
    seed: int,
) -> Found:
    """The first accepted one of what is proposed, or found by a search, else the best."""
    camera, view = rig.cameras[name], views[name]
    best = Found(camera, -math.inf, False)
    for T in _candidates(view, camera, within, list(_proposals(rig, name, accepted)), seed):
        best = max(best, settle(view, camera.moved_to(T)), key=lambda f: f.contrast)
        if best.accepted:
            break
    return best


def _candidates(
    view: View, camera: Camera, within: Range, proposals: Sequence[Array], seed: int
) -> Iterator[Array]:
    """What is proposed, and only then what a search finds."""
    yield from proposals
    box = Box(camera.T_camera_lidar, within.rotation_rad, within.translation_m)
    responses = respond(
        view.grays,
        view.clouds,
        camera,
        range_rad=within.rotation_rad,
        most=SEARCH_WINDOWS,
        seed=seed,
    )
    if len(responses.maps):
        yield from search_box(responses, box, proposals=proposals, seed=seed)


def _proposals(rig: Rig, name: str, accepted: Mapping[str, Found]) -> Iterator[Array]:
    """Where the accepted cameras put another: by known relative poses, then by the guess's."""
    poses = {other: f.camera.T_camera_lidar for other, f in accepted.items()}
    for pair in rig.relative_poses:
        if pair.a == name and pair.b in poses:
            yield pair.T_a_b @ poses[pair.b]
        elif pair.b == name and pair.a in poses:
            yield np.linalg.inv(pair.T_a_b) @ poses[pair.a]
    for other, T in poses.items():
        guess = rig.cameras[name].T_camera_lidar
        yield guess @ np.linalg.inv(rig.cameras[other].T_camera_lidar) @ T


def _judged(near: Found, far: Found | None) -> Found:
    """The accepted one; what is near the guess also if nothing else comes near its contrast."""
    if far is None or near.accepted:
        return near
    if far.accepted:
        return far
    alone = near.contrast >= CLEARER * far.contrast or _same(near, far)
    if near.contrast >= ACCEPTED_NEAR and alone:
        return replace(near, accepted=True)
    return max(near, far, key=lambda found: found.contrast)


def _same(one: Found, two: Found) -> bool:
    step = one.camera.T_camera_lidar @ np.linalg.inv(two.camera.T_camera_lidar)
    return angle_deg(step[:3, :3]) < SAME_DEG and float(np.linalg.norm(step[:3, 3])) < SAME_M
