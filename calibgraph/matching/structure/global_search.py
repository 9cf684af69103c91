"""Global search: where the rounds begin, at the guess if it is near enough, else where it finds.

A pose is accepted when image and cloud agree at it far better than by chance; the more poses were
tried, the better they must agree. Each camera is tried at the guess first, then wherever the
cameras located so far propose it, then all over the range. A camera that has been located proposes
poses for the others at once. If no pose of a camera is accepted, it has not been found: the best of
the rejected poses is never taken.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from calibgraph.matching.structure.box_search import Box, search_box
from calibgraph.matching.structure.correlation_maps import correlate
from calibgraph.matching.structure.pose_refinement import (
    ACCEPTED,
    CameraFrames,
    Candidate,
    refine,
    select_candidate,
)
from calibgraph.matching.structure.proposals import propose
from calibgraph.model.rig import Rig
from calibgraph.progress import Progress

Array = NDArray[np.float64]

SEARCH_WINDOWS = 2100  # of the first search, per camera over all frames
SEARCHES = 2  # per camera
RETRY_EFFORT = 3
"""Factor on the candidates, and as far as memory allows on the windows, of a second search."""

MAX_PARALLEL = 4  # cameras searched at once; then those that were located propose for the others


@dataclass(frozen=True, eq=False)
class SearchRange:
    """How far from the guess to search, per axis."""

    rotation_rad: float
    translation_m: float

    @property
    def rotation_deg(self) -> float:
        """The rotation in degrees."""
        return float(np.degrees(self.rotation_rad))


def locate_cameras(
    rig: Rig,
    frames: Mapping[str, CameraFrames],
    search_range: SearchRange,
    *,
    seed: int,
    out_of_time: Callable[[], bool],
    pool: Executor,
    progress: Progress,
) -> dict[str, Candidate]:
    """Locate all cameras of a rig.

    Args:
        rig: lenses, the guess, and relative poses if known.
        frames: images and clouds, by the names of the cameras.
        search_range: about the guess.
        seed: of the search.
        out_of_time: checked before each search, and after each pose that is tried.
        pool: a thread per camera, which waits for the cores of its frames.
        progress: called as the work goes on.

    Returns:
        The best candidate per camera, accepted if the camera has been located.
    """
    total = SEARCHES * len(rig.cameras)
    progress("trying the guess", 0, total)
    refined = pool.map(lambda name: refine(frames[name], rig.cameras[name]), rig.cameras)
    state = _SearchState(dict(zip(rig.cameras, refined, strict=True)))
    search = _CameraSearch(rig, frames, search_range, seed, out_of_time)
    while True:
        best, new = state.select()
        missing = state.missing(best) if new else state.next_to_search(best)
        if not missing or out_of_time():
            return best
        if new:
            work = partial(search.try_proposals, state.count_proposers(new))
        else:
            progress(state.describe(missing), sum(state.searches.values()), total)
            work = partial(search.search_range, state.count_searches(missing))
        state.add(missing, pool.map(work, missing))


class _SearchState:
    """What has been tried for each camera, and the best candidates so far.

    Attributes:
        near: the candidates refined from the guess.
        far: the best candidates of proposals and searches.
        proposers: the located cameras that have proposed poses for the others.
        searches: number of searches per camera.
    """

    def __init__(self, near: Mapping[str, Candidate]) -> None:
        self.near = near
        self.far: dict[str, Candidate] = {}
        self.proposers: set[str] = set()
        self.searches = dict.fromkeys(near, 0)

    def select(self) -> tuple[dict[str, Candidate], dict[str, Candidate]]:
        """The best candidate per camera, and the accepted ones that have not proposed yet.

        Candidates that are accepted only because a search found no better one come last.
        """
        for after_search in (False, True):
            best = {
                name: select_candidate(
                    near, self.far.get(name), after_search=after_search and self.searches[name] > 0
                )
                for name, near in self.near.items()
            }
            accepted = {name: candidate for name, candidate in best.items() if candidate.accepted}
            new = {name: c for name, c in accepted.items() if name not in self.proposers}
            if new:
                break
        return best, new

    def missing(self, best: Mapping[str, Candidate]) -> list[str]:
        """The cameras that have not been located."""
        return [name for name in self.near if not best[name].accepted]

    def next_to_search(self, best: Mapping[str, Candidate]) -> list[str]:
        """The missing cameras to search now: those with the fewest searches."""
        left = [name for name in self.missing(best) if self.searches[name] < SEARCHES]
        return sorted(left, key=self.searches.__getitem__)[:MAX_PARALLEL]

    def describe(self, missing: Sequence[str]) -> str:
        """What is searched now, and how little the searches before have found."""
        words = []
        for name in missing:
            z_score = self.far[name].z_score if name in self.far else -math.inf
            before = f" (best z-score {z_score:.1f}, {ACCEPTED:g} needed)" if z_score > 0 else ""
            words.append(name + before)
        return f"searching: {', '.join(words)}"

    def count_proposers(self, new: dict[str, Candidate]) -> dict[str, Candidate]:
        """Count these cameras among those that have proposed, and return them."""
        self.proposers |= new.keys()
        return new

    def count_searches(self, names: Iterable[str]) -> dict[str, int]:
        """Count a search of each of these cameras, and return the number of searches per camera."""
        self.searches |= {name: self.searches[name] + 1 for name in names}
        return dict(self.searches)

    def add(self, names: Iterable[str], candidates: Iterable[Candidate]) -> None:
        """Keep each candidate that is the best of its camera away from the guess."""
        for name, candidate in zip(names, candidates, strict=True):
            before = self.far.get(name, candidate)
            self.far[name] = max(candidate, before, key=lambda each: each.z_score)


@dataclass(frozen=True, eq=False)
class _CameraSearch:
    """Tries poses of one camera of a rig at a time, see :func:`locate_cameras`."""

    rig: Rig
    frames: Mapping[str, CameraFrames]
    range: SearchRange
    seed: int
    out_of_time: Callable[[], bool]

    def search_range(self, searches: Mapping[str, int], name: str) -> Candidate:
        """Search all of the range for a camera, with more effort if it is not the first time."""
        camera, frames = self.rig.cameras[name], self.frames[name]
        effort = 1 if searches[name] == 1 else RETRY_EFFORT
        seed = self.seed + 1000 * (searches[name] - 1)
        maps = correlate(
            frames.grays,
            frames.clouds,
            camera,
            frames.cores,
            range_rad=self.range.rotation_rad,
            max_windows=effort * SEARCH_WINDOWS // len(frames.grays),
            seed=seed,
        )
        if not len(maps.maps):
            return Candidate(camera, -math.inf, False)
        transforms = search_box(maps, self._box(name), frames.cores, effort=effort, seed=seed)
        return self.first_accepted(name, ([T_camera_lidar] for T_camera_lidar in transforms))

    def try_proposals(self, located: Mapping[str, Candidate], name: str) -> Candidate:
        """Try a camera at the poses that follow from those of located cameras."""
        known = {other: c.camera.T_camera_lidar for other, c in located.items()}
        groups = propose(name, self.rig, known, self.frames, self._box(name), seed=self.seed)
        return self.first_accepted(name, groups)

    def first_accepted(self, name: str, groups: Iterable[Iterable[Array]]) -> Candidate:
        """The best candidate of the first group of T_camera_lidar that has an accepted one.

        If none has, the best of all.
        """
        camera = self.rig.cameras[name]
        best = Candidate(camera, -math.inf, False)
        for group in groups:
            for T_camera_lidar in group:
                refined = refine(self.frames[name], camera.moved_to(T_camera_lidar))
                best = max(best, refined, key=lambda candidate: candidate.z_score)
                if self.out_of_time():
                    return best
            if best.accepted:
                break
        return best

    def _box(self, name: str) -> Box:
        guess = self.rig.cameras[name].T_camera_lidar
        return Box(guess, self.range.rotation_rad, self.range.translation_m)
