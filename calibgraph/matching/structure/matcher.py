"""The matcher `structure` as the pipeline sees it: one table of correspondences per round."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np

from calibgraph.io.dataset import Dataset, Frame, spread_out
from calibgraph.matching.protocol import Stage1Source, Start
from calibgraph.matching.structure.consensus import find_consensus
from calibgraph.matching.structure.frame_cache import Decoded
from calibgraph.matching.structure.global_search import Range, View, locate
from calibgraph.matching.structure.peaks import correspondences_at_peaks
from calibgraph.matching.structure.schedule import LEVELS, Level
from calibgraph.matching.structure.shift_scores import Scores, joined, score_frame
from calibgraph.model.correspondences import Correspondences, concatenate
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.rig import Camera, Rig
from calibgraph.progress import Progress

SYSTEMATIC_ROTATION_RAD = float(np.radians(0.09))
SYSTEMATIC_TRANSLATION_M = 0.02
"""Error per axis that the frames of a scene share: its root mean square over recorded scenes of two
rigs, each from a few places. One place alone is worse; synthetic scenes are better."""

_NEAR_ROUNDS = (2, 4)
_AFTER_SEARCH, SURE = 3, 20.0
"""The round that goes on where the search ends, and the least contrast for that. With a sparse
LiDAR poses with less were 2 degrees off, and the first rounds brought them back."""

FRAME_WINDOWS = 6_000  # bounds the time of a single frame
SHARING_FRAMES = 20
"""At most so many frames share a level's windows: with fewer windows in a frame than these leave,
few of its groups have enough of them, and more frames would give fewer matches."""
MOST_FRAMES = 30  # bounds time and memory, which are proportional from SHARING_FRAMES on
LOCATE_FRAMES = 7
SEARCH_DEG, SEARCH_M = 20.0, 1.5
MAX_SEARCH_DEG, MAX_SEARCH_M = 45.0, 5.0


class StructureMatcher:
    """Weight-free matching, by a search within a range of the guess and rounds from what it finds.

    It remembers the decoded images and clouds of a dataset's frames from round to round.

    Args:
        seed: of the searches.
        search_deg: how far the guess may be off, per axis; None for no search: the rounds begin at
            the guess, which may be off by about 2.5 degrees and 25 cm.
        search_m: the same of the translation.
        most_frames: how many frames of a dataset are heeded, evenly spread over it; None for all.
        levels: the rounds, coarse to fine.

    Raises:
        ValueError: if only one of the ranges is None, or one is out of bounds, or no frame is left.
    """

    stage1: Stage1Source = "rig"
    fails_on_images = True

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
            raise ValueError(f"at least one frame must be heeded, found most_frames={most_frames}")
        self.seed = seed
        self.search = _range(search_deg, search_m)
        self.most_frames = most_frames
        self.levels = levels
        self.rounds = len(levels)
        self._decoded = Decoded()

    @property
    def tracking_rounds(self) -> tuple[int, ...]:
        """The rounds for starts that are off by up to 0.7 degrees and 20 cm."""
        return tuple(index for index in _NEAR_ROUNDS if index < self.rounds)

    def locate(
        self,
        dataset: Dataset,
        rig: Rig,
        *,
        out_of_time: Callable[[], bool],
        progress: Progress,
    ) -> Start:
        """Where the rounds begin: at the guess, or where a search finds the cameras."""
        if self.search is None:
            return Start(rig)
        self._decoded.keep_only(dataset.frames)
        frames = spread_out(dataset.frames, LOCATE_FRAMES)
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            clouds = list(pool.map(self._decoded.cloud, frames))
            image = self._decoded.image
            views = {
                name: View(list(pool.map(partial(image, name=name, camera=camera), frames)), clouds)
                for name, camera in rig.cameras.items()
            }
            found = locate(
                rig,
                views,
                self.search,
                seed=self.seed,
                out_of_time=out_of_time,
                pool=pool,
                progress=progress,
            )
        poses = {
            name: (f.camera if f.accepted else rig.cameras[name]).T_camera_lidar
            for name, f in found.items()
        }
        sure = all(f.accepted and f.contrast >= SURE for f in found.values())
        return Start(
            rig.moved_to(poses),
            first_round=min(_AFTER_SEARCH, self.rounds - 1) if sure else 0,
            findings=MatcherFindings(
                found={n: f.contrast for n, f in found.items() if f.accepted},
                missed={n: max(0.0, f.contrast) for n, f in found.items() if not f.accepted},
                range_rotation_deg=self.search.rotation_deg,
                range_translation_m=self.search.translation_m,
            ),
        )

    def match(
        self, dataset: Dataset, rig: Rig, *, round_index: int, progress: Progress
    ) -> Correspondences:
        """Match every camera in every frame, from the rig's poses."""
        level = self.levels[round_index]
        sharing = min(len(dataset.frames), SHARING_FRAMES)
        most = min(level.max_windows // sharing, FRAME_WINDOWS)
        self._decoded.keep_only(dataset.frames)
        work = len(rig.cameras) * len(dataset.frames)
        tables, contrasts = [], {}
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            for index, (name, camera) in enumerate(rig.cameras.items()):
                done = round_index * work + index * len(dataset.frames)
                what = f"round {round_index + 1} of {self.rounds}: {name}"
                progress(what, done, self.rounds * work)
                score = partial(self._score, name, camera, level, most)
                scores = joined(list(pool.map(score, dataset.frames)))
                twist, contrasts[name] = find_consensus(scores, level, seed=self.seed)
                least = level.min_quality
                tables.append(correspondences_at_peaks(scores, twist, name, min_quality=least))
        near = Range(self.levels[0].rotation_rad, self.levels[0].translation_m)
        findings = MatcherFindings(
            z_score=contrasts,
            systematic_rotation_rad=SYSTEMATIC_ROTATION_RAD,
            systematic_translation_m=SYSTEMATIC_TRANSLATION_M,
            range_rotation_deg=near.rotation_deg,
            range_translation_m=near.translation_m,
        )
        settings = {"matcher": "structure", "round": round_index, "seed": self.seed}
        metadata = {**settings, **findings.to_metadata()}
        return replace(concatenate(tables), metadata=metadata)

    def _score(self, name: str, camera: Camera, level: Level, most: int, frame: Frame) -> Scores:
        gray, cloud = self._decoded.image(frame, name, camera), self._decoded.cloud(frame)
        return score_frame(gray, cloud, camera, level, frame=frame.index, most=most)


def _range(search_deg: float | None, search_m: float | None) -> Range | None:
    """The range of the search, None for no search."""
    if search_deg is None and search_m is None:
        return None
    if search_deg is None or search_m is None:
        raise ValueError("give both ranges of the search, or None for both")
    if not (0 < search_deg <= MAX_SEARCH_DEG and 0 < search_m <= MAX_SEARCH_M):
        raise ValueError(
            f"the search reaches up to {MAX_SEARCH_DEG:g} deg and {MAX_SEARCH_M:g} m per axis, "
            f"found {search_deg:g} deg and {search_m:g} m"
        )
    return Range(float(np.radians(search_deg)), search_m)
