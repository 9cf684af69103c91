"""The matcher `structure`: a global search, then one table of correspondences per round."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future
from copy import copy
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import DatasetError
from calibgraph.graph.lens import LensVariable
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.io.frame import Frame
from calibgraph.matching.protocol import Start
from calibgraph.matching.structure.consensus import find_consensus
from calibgraph.matching.structure.frame_cache import FrameCache, cache_of, load_camera_frames
from calibgraph.matching.structure.global_search import Locator
from calibgraph.matching.structure.peaks import extract_correspondences
from calibgraph.matching.structure.pose_refinement import CONFIDENT
from calibgraph.matching.structure.pose_search import PoseSearch, SearchRange
from calibgraph.matching.structure.schedule import LEVELS, Level
from calibgraph.matching.structure.shift_scores import (
    ShiftScores,
    concatenate_scores,
    score_frame,
)
from calibgraph.matching.structure.window_weights import window_network
from calibgraph.model.clock import clock_of
from calibgraph.model.config import LensPart, Stage1Source
from calibgraph.model.correspondences import Correspondences, concatenate
from calibgraph.model.findings import STAGE1, MatcherFindings, error_components
from calibgraph.model.rig import Camera, Rig
from calibgraph.parallel import Threads, core_pool
from calibgraph.progress import Progress
from factors import displace, fields_px

_TRACKING_ROUNDS = (2, 4)
_ROUND_AFTER_SEARCH = 3
"""The round that follows a search, if it is confident of all cameras. With a sparse LiDAR, poses of
lower z-scores were 2 degrees off, and the first rounds corrected them. In few frames the search
itself ends at the fine levels, and coarse rounds would lose what it has found."""

FRAME_WINDOWS = 6_000  # bounds the time of a single frame
SHARING_FRAMES = 20
"""Largest number of frames that share a level's windows: with fewer windows per frame, few of its
groups have enough of them, and more frames would give fewer matches."""
MOST_FRAMES = 30  # bounds time and memory, which are proportional from SHARING_FRAMES on
SEARCH_FRAMES = 7
SEARCH_DEG, SEARCH_M = 20.0, 1.5
MAX_SEARCH_DEG, MAX_SEARCH_M = 45.0, 5.0
LEAST_WINDOWS, TRIED_WINDOWS = 300, 2_000
"""Least number of fine windows with structure, of those tried; with fewer the search fails. Of
scans thinned to 2000, 3000, 4000 and 5000 points 25, 250, 750 and 1300 have it: with 4000 cameras
are found. Whole scans of 16 beams have 1600."""


class StructureMatcher:
    """Matching with what is shipped: a search about the guess, then rounds, coarse to fine.

    The prepared clouds and images of a dataset's frames are kept from round to round.

    Args:
        seed: of the searches.
        search_deg: largest error of the guess, per axis [deg]; 0 or None for no search: the rounds
            begin at the guess, which may be off by about 2.5 degrees and 25 cm.
        search_m: the same of the translation [m].
        most_frames: most frames of a dataset that are used, chosen of more; None for all.
        levels: the rounds, coarse to fine.

    Raises:
        ValueError: if only one of the ranges is None, or one is out of bounds, or no frame is left.
    """

    stage1: Stage1Source = "rig"
    image_checks_can_fail = True

    def __init__(
        self,
        *,
        seed: int = 0,
        search_deg: float | None = SEARCH_DEG,
        search_m: float | None = SEARCH_M,
        most_frames: int | None = MOST_FRAMES,
        levels: Sequence[Level] = LEVELS,
    ) -> None:
        if most_frames is not None and most_frames < 1:
            raise ValueError(f"at least one frame must be used, found most_frames={most_frames}")
        self.seed = seed
        self.search_range = _to_search_range(search_deg, search_m)
        self.most_frames = most_frames
        self.levels = list(levels)
        self.estimate: tuple[LensPart, ...] = ()
        self.rounds = len(levels)
        self._cache = FrameCache()
        self._backwards: dict[float, bool] = {}

    def with_estimate(self, parts: Sequence[LensPart]) -> "StructureMatcher":
        """The matcher that searches parts of lens and clock together with the pose."""
        other = copy(self)
        other.estimate, other._cache = tuple(parts), FrameCache()
        return other

    @property
    def tracking_rounds(self) -> tuple[int, ...]:
        """The rounds for starts that are off by up to 0.7 degrees and 20 cm."""
        return tuple(index for index in _TRACKING_ROUNDS if index < self.rounds)

    def locate(
        self,
        dataset: Dataset,
        rig: Rig,
        *,
        out_of_time: Callable[[], bool],
        progress: Progress,
    ) -> Start:
        """Start where a search locates the cameras; at the guess those that it does not locate."""
        cache = self._cache_of(dataset)
        frames = spread_out(dataset.frames, SEARCH_FRAMES)
        self._require_structure(cache, frames, rig)
        if self.search_range is None:
            return Start(rig)
        with core_pool() as cores, Threads(len(rig.cameras)) as pool:
            seen = load_camera_frames(cache, frames, rig, cores)
            search = PoseSearch(
                rig, seen, self.search_range, seed=self.seed, out_of_time=out_of_time
            )
            located, findings = Locator(search, pool, progress).locate()
        findings = replace(findings, **_in_reach(*self.search_range))
        start = rig.moved_to({**rig.T_camera_lidar, **located})
        return Start(start, self._first_round(findings), findings)

    def match(
        self, dataset: Dataset, rig: Rig, *, round_index: int, progress: Progress
    ) -> Correspondences:
        """Match every camera in every frame, about the rig's extrinsics."""
        cache = self._cache_of(dataset)
        work = len(rig.cameras) * len(dataset.frames)
        tables, z_scores = [], {}
        with core_pool() as cores, core_pool() as pool:  # a few cameras' scores are copied at once
            level = self.levels[round_index]
            waiting = self._submit_scores(cache, dataset.frames, rig, level, cores=cores)
            matches = pool.map(partial(self._match_camera, level), waiting, waiting.values())
            for index, name in enumerate(rig.cameras):
                what = f"round {round_index + 1} of {self.rounds}: {name}"
                done = round_index * work + index * len(dataset.frames)
                progress(what, done, self.rounds * work)
                table, z_scores[name] = next(matches)
                tables.append(table)
        return concatenate(tables).with_metadata(self._metadata(round_index, z_scores))

    def _require_structure(self, cache: FrameCache, frames: Sequence[Frame], rig: Rig) -> None:
        """Raise if no cloud has enough windows."""
        camera, finest = next(iter(rig.cameras.values())), self.levels[-1]
        spacings = finest.spacing_rad, finest.stride_spacings
        most, best = -1, frames[0]
        for frame in frames:
            count = cache.cloud(frame).count_windows(camera, *spacings, most=TRIED_WINDOWS)
            if count >= LEAST_WINDOWS:
                return
            most, best = max((most, best), (count, frame), key=lambda pair: pair[0])
        points = len(cache.cloud(best).points_lidar_m)
        raise DatasetError(
            f"{best.cloud_path}: its {points} points have {most} neighbourhoods with structure, "
            f"the other clouds no more; at least {LEAST_WINDOWS} are needed. Give whole scans that "
            "are not thinned, several scans joined, or places with more than a bare wall"
        )

    def release(self) -> None:
        """Drop the frames that are kept from round to round."""
        self._cache = FrameCache()

    def _cache_of(self, dataset: Dataset) -> FrameCache:
        """The caches of this dataset's frames alone."""
        cache = cache_of(dataset.frames, self._cache)
        cache.keep_only(dataset.frames)
        return cache

    def _first_round(self, of_search: MatcherFindings) -> int:
        if self.estimate:  # the search's pose makes up for errors of the rig's lens and clock
            return 0
        found, missed = of_search.found, of_search.missed
        confident = not missed and min(found.values()) >= CONFIDENT
        looked_at = not of_search.chance.keys().isdisjoint(found)
        return min(_ROUND_AFTER_SEARCH, self.rounds - 1) if confident or looked_at else 0

    def _submit_scores(
        self, cache: FrameCache, frames: Sequence[Frame], rig: Rig, level: Level, *, cores: Executor
    ) -> dict[str, deque[Future[ShiftScores]]]:
        """Score every camera in every frame; frame by frame, so that cameras share its windows.

        Every other round of a spacing goes backwards: it begins with the frames whose images and
        windows are still in the cache.
        """
        per_frame = level.max_windows // min(len(frames), SHARING_FRAMES)
        max_windows = min(per_frame, FRAME_WINDOWS)

        def score(frame: Frame, name: str, camera: Camera) -> ShiftScores:
            gray, cloud = cache.image(frame, name, camera), cache.cloud(frame)
            twist, number = frame.twist_per_s, frame.index
            scores = score_frame(
                gray, cloud, camera, level, frame=number, max_windows=max_windows, twist_per_s=twist
            )
            return self._with_free(scores, camera, twist)

        waiting: dict[str, deque[Future[ShiftScores]]] = {name: deque() for name in rig.cameras}
        backwards = self._backwards[level.spacing_rad] = not self._backwards.get(level.spacing_rad)
        add = deque.appendleft if backwards else deque.append
        for frame in reversed(frames) if backwards else frames:
            for name, camera in rig.cameras.items():
                add(waiting[name], cores.submit(score, frame, name, camera))
        return waiting

    def _with_free(
        self, scores: ShiftScores, camera: Camera, twist_per_s: Array | None
    ) -> ShiftScores:
        """Scores with what is free of lens and clock."""
        if not self.estimate:
            return scores
        free, points_m = LensVariable.of(camera, self.estimate).free, scores.points_lidar_m
        if twist_per_s is not None:
            times_s = clock_of(camera).times_s(scores.pixels_px[:, 1])
            points_m = displace(points_m, twist_per_s, -times_s)
        fields = fields_px(points_m, camera.T_camera_lidar, free, twist_per_s)[1]
        return scores.with_unknowns(fields[6:])

    def _match_camera(
        self, level: Level, name: str, waiting: deque[Future[ShiftScores]]
    ) -> tuple[Correspondences, float]:
        """The correspondences of one camera in all frames, and their z-score."""
        try:
            scores = concatenate_scores([waiting.popleft().result() for _ in range(len(waiting))])
        finally:  # after an error in one frame, the others are not needed
            for future in waiting:
                future.cancel()
        unknowns, z_score = find_consensus(scores, level, seed=self.seed)
        table = extract_correspondences(scores, unknowns, name, min_quality=level.min_quality)
        return table, z_score

    def _metadata(self, round_index: int, z_scores: Mapping[str, float]) -> dict[str, Any]:
        """The settings and findings of a round."""
        first = self.levels[0]
        findings = MatcherFindings(
            z_score=z_scores,
            **error_components().matchers["structure"],
            **_in_reach(first.rotation_rad, first.translation_m),
        )
        settings = {
            "matcher": "structure",
            "round": round_index,
            "seed": self.seed,
            "window_weights": window_network().origin,
        }
        return {STAGE1: self.stage1, **settings, **findings.to_metadata()}


def _to_search_range(search_deg: float | None, search_m: float | None) -> SearchRange | None:
    """The range of the search, None for no search."""
    if not search_deg and not search_m:
        return None
    if search_deg is None or search_m is None:
        raise ValueError("give both ranges of the search, or None for both")
    if not (0 < search_deg <= MAX_SEARCH_DEG and 0 < search_m <= MAX_SEARCH_M):
        raise ValueError(
            f"the search reaches up to {MAX_SEARCH_DEG:g} deg and {MAX_SEARCH_M:g} m per axis, "
            f"found {search_deg:g} deg and {search_m:g} m; give 0 for both to search nothing"
        )
    return float(np.radians(search_deg)), search_m


def _in_reach(rotation_rad: float, translation_m: float) -> dict[str, Any]:
    """The range of a search, or of a round, as findings have it."""
    degrees = float(np.degrees(rotation_rad))
    return {"range_rotation_deg": degrees, "range_translation_m": translation_m}
