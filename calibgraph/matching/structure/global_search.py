"""From where the rounds begin: the guess if it is near enough, or what a global search finds.

A pose is accepted when image and cloud agree at it far better than by chance; the more places were
tried, the better they must agree. Each camera is tried at the guess first, then wherever the
cameras found so far put it, then all over the range, as often as is useful; what one finds helps
the others at once. What is not accepted is not found: the best of the bad is never good enough.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from calibgraph.matching.structure.box_search import Box, search_box
from calibgraph.matching.structure.consensus import find_consensus
from calibgraph.matching.structure.correlation_maps import respond
from calibgraph.matching.structure.epipolar import overlap_pose
from calibgraph.matching.structure.schedule import LEVELS
from calibgraph.matching.structure.shift_scores import joined, score_frame
from calibgraph.matching.structure.windows import Cloud
from calibgraph.model.geometry import angle_deg, invert, relative_transform
from calibgraph.model.rig import Camera, Rig
from calibgraph.progress import Progress
from calibgraph.solver.augmented_fit import moved_by

Array = NDArray[np.float64]

ACCEPTED = 16.0
"""Least contrast after the last of the levels. On recorded scenes within 20 deg and 1.5 m of the
guess, wrong poses had up to 15, right ones mostly from 17 on."""

ACCEPTED_NEAR = ((12.0, 1 / 1.3), (11.0, 1.0), (8.0, 1.3))
"""Contrasts of what the guess settles to, and by how often they must be as high as all that is
found elsewhere: that it is the guess, of all places tried, which wrongly agrees best is unlikely.
Only after a search: guesses 1.5 to 3 deg off have settled 30 to 50 cm off with 12.3, where the
right poses had 19."""

SAME_DEG, SAME_M = 0.5, 0.15

HOPELESS = 7.5  # of any level: no right pose had less than 11 after the first
PROMISING, GAIN = 11.0, 1.05  # contrast from which to go on, and by how much it must grow
SETTLING = (
    (replace(LEVELS[0], translation_m=0.5), 6_000),
    (replace(LEVELS[1], translation_m=0.5), 20_000),
    (replace(LEVELS[2], translation_m=0.3), 20_000),
)
"""Levels, and how many windows they take, per camera over all frames. They look farther than the
rounds: a search is good to about a degree and some decimetres."""

LENGTH_STEP_M = 0.5  # of unknown translations: settling reaches half of it
OUTSIDE = 0.2  # of a range's half-width: how far outside of it a proposal may be

SEARCH_WINDOWS = 2100  # of the first search, per camera over all frames
SEARCHES = 2  # per camera
WIDER = (
    3  # times the candidates, and as far as memory allows windows, of a search after one in vain
)
SIDE_BY_SIDE = 4  # cameras; then those that were found propose for the others


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

    @property
    def rotation_deg(self) -> float:
        """The rotation in degrees."""
        return float(np.degrees(self.rotation_rad))


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
    progress: Progress,
) -> dict[str, Found]:
    """Find all cameras of a rig.

    Args:
        rig: lenses, the guess, and relative poses if known.
        views: by the names of the cameras.
        within: where to search what is not near the guess.
        seed: of the search.
        out_of_time: asked before each search, and before each pose that it tries.
        pool: where cameras are worked on side by side.
        progress: to be told how far it is.
    """
    names = list(rig.cameras)
    seeker = _Seeker(rig, views, within, seed, out_of_time)
    progress("trying the guess", 0, SEARCHES * len(names))
    settled = pool.map(lambda name: settle(views[name], rig.cameras[name]), names)
    near = dict(zip(names, settled, strict=True))
    far: dict[str, Found] = {}
    asked: set[str] = set()  # the accepted cameras that the others were proposed from
    searches = dict.fromkeys(names, 0)
    while True:
        for late in (False, True):  # what needs no search, before what is taken after one
            tried = {n: late and searches[n] > 0 for n in names}
            best = {n: _judged(near[n], far.get(n), searched=tried[n]) for n in names}
            news = {n: f for n, f in best.items() if f.accepted and n not in asked}
            if news:
                break
        missing = [name for name in names if not best[name].accepted]
        if not news:
            missing = [name for name in missing if searches[name] < SEARCHES]
            missing = sorted(missing, key=searches.__getitem__)[:SIDE_BY_SIDE]
        if not missing or out_of_time():
            return best
        if news:
            asked |= news.keys()
            work = partial(seeker.propose, news)
        else:
            what = f"searching: {', '.join(missing)}"
            progress(what, sum(searches.values()), SEARCHES * len(names))
            searches |= {name: searches[name] + 1 for name in missing}
            work = partial(seeker.search, dict(searches))
        for name, found in zip(missing, pool.map(work, missing), strict=True):
            far[name] = max(found, far.get(name, found), key=lambda f: f.contrast)


def settle(view: View, camera: Camera) -> Found:
    """Follow the agreement of a view from a camera's pose, until accepted or no better."""
    found = _descend(view, camera)
    while PROMISING <= found.contrast < ACCEPTED:
        again = _descend(view, found.camera)
        if again.contrast < GAIN * found.contrast:
            break
        found = again
    return found


def _descend(view: View, camera: Camera) -> Found:
    """Go through the levels once, or until it is hopeless."""
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


@dataclass(frozen=True, eq=False)
class _Seeker:
    """Looks for one camera of a rig at a time, see :func:`locate`."""

    rig: Rig
    views: Mapping[str, View]
    within: Range
    seed: int
    out_of_time: Callable[[], bool]

    def search(self, searches: Mapping[str, int], name: str) -> Found:
        """Search all of the range for a camera, with more effort if it is not the first time."""
        camera, view = self.rig.cameras[name], self.views[name]
        effort = 1 if searches[name] == 1 else WIDER
        seed = self.seed + 1000 * (searches[name] - 1)
        responses = respond(
            view.grays,
            view.clouds,
            camera,
            range_rad=self.within.rotation_rad,
            most=effort * SEARCH_WINDOWS // len(view.grays),
            seed=seed,
        )
        if not len(responses.maps):
            return Found(camera, -math.inf, False)
        found = search_box(responses, self._box(name), effort=effort, seed=seed)
        return self._first(name, ([T] for T in found))

    def propose(self, accepted: Mapping[str, Found], name: str) -> Found:
        """Try a camera where accepted cameras put it."""
        poses = {other: found.camera.T_camera_lidar for other, found in accepted.items()}
        return self._first(name, self._proposals(poses, name))

    def _first(self, name: str, groups: Iterable[Iterable[Array]]) -> Found:
        """The best of the first group of poses that has one which settles to an accepted one.

        If none has, the best of all.
        """
        camera = self.rig.cameras[name]
        best = Found(camera, -math.inf, False)
        for group in groups:
            for T in group:
                settled = settle(self.views[name], camera.moved_to(T))
                best = max(best, settled, key=lambda found: found.contrast)
                if self.out_of_time():
                    return best
            if best.accepted:
                break
        return best

    def _proposals(self, poses: Mapping[str, Array], name: str) -> Iterator[Iterable[Array]]:
        """By known relative poses, by what both see, and by the guess's relative poses.

        What both see leaves the length of a translation open. Right but for that, a pose may be
        accepted; so all lengths are one group.
        """
        camera = self.rig.cameras[name]
        for pair in self.rig.relative_poses:
            if pair.a == name and pair.b in poses:
                yield [pair.T_a_b @ poses[pair.b]]
            elif pair.b == name and pair.a in poses:
                yield [invert(pair.T_a_b) @ poses[pair.a]]
        for other, T in poses.items():
            grays = self.views[other].grays, self.views[name].grays
            T_this_other = overlap_pose(self.rig.cameras[other], camera, *grays, seed=self.seed)
            if T_this_other is not None:
                yield _at_lengths(T_this_other, T, self._box(name))
        for other, T in poses.items():
            T_guess_other = self.rig.cameras[other].T_camera_lidar
            yield [relative_transform(camera.T_camera_lidar, T_guess_other) @ T]

    def _box(self, name: str) -> Box:
        within = self.within
        guess = self.rig.cameras[name].T_camera_lidar
        return Box(guess, within.rotation_rad, within.translation_m)


def _at_lengths(T_b_a: Array, T_a_lidar: Array, box: Box) -> Iterator[Array]:
    """Camera b in a box, by the pose of a and by T_b_a with a translation of unknown length."""
    apart = np.linalg.norm(relative_transform(T_a_lidar, box.guess)[:3, 3])
    farthest = apart + np.sqrt(3) * box.translation_m
    for length in np.arange(LENGTH_STEP_M / 2, farthest + LENGTH_STEP_M, LENGTH_STEP_M):
        T = T_b_a.copy()
        T[:3, 3] *= length
        T = T @ T_a_lidar
        if box.excess(box.displacement(T)[None])[0] < OUTSIDE:
            yield T


def _judged(near: Found, far: Found | None, *, searched: bool) -> Found:
    """The accepted one; after a search, what is near the guess if all else is no better."""
    if far is None or near.accepted:
        return near
    best = max(near, far, key=lambda found: found.contrast)
    mine, rival = (best, 0.0) if _same(near, far) else (near, far.contrast)
    if any(mine.contrast >= max(least, times * rival) for least, times in ACCEPTED_NEAR):
        return replace(mine, accepted=mine.accepted or searched)
    return best


def _same(one: Found, two: Found) -> bool:
    step = relative_transform(one.camera.T_camera_lidar, two.camera.T_camera_lidar)
    return angle_deg(step[:3, :3]) < SAME_DEG and float(np.linalg.norm(step[:3, 3])) < SAME_M
