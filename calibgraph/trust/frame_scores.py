"""Shift scores of some frames of a dataset, from a result's poses: the input of image evidence."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

from calibgraph.io.dataset import Dataset
from calibgraph.io.frame import Frame
from calibgraph.matching.structure.frame_cache import FrameCache, cache_of
from calibgraph.matching.structure.prepared_image import PreparedImage
from calibgraph.matching.structure.schedule import LEVELS, Level
from calibgraph.matching.structure.shift_scores import (
    ShiftScores,
    concatenate_scores,
    score_frame,
)
from calibgraph.model.rig import Camera

Images = Sequence[PreparedImage]
"""Images of one camera, one per frame."""

MAX_WINDOWS, SHARING_FRAMES = (
    10_000,
    10,
)  # per camera over that many frames; with more frames, as many each
WIDE, FINER = LEVELS[1], LEVELS[2]


class FrameScorer:
    """Scores frames in parallel; clouds are decoded once."""

    def __init__(self, dataset: Dataset, frames: Sequence[Frame], pool: ThreadPoolExecutor) -> None:
        self.frames = frames
        self.dataset = dataset
        self._pool = pool
        self._cache = cache_of(frames, FrameCache())

    def load_images(self, name: str, camera: Camera) -> list[PreparedImage]:
        """Images of a camera, one per frame."""
        load = partial(self._cache.image, name=name, camera=camera)
        return list(self._pool.map(load, self.frames))

    def score(
        self, images: Images, camera: Camera, level: Level, *, offset: int = 0
    ) -> list[ShiftScores | None]:
        """Score each image against the cloud ``offset`` frames later; None where there is none."""
        one = partial(self._score_frame, camera=camera, level=level, offset=offset)
        return list(self._pool.map(one, images, self.frames))

    def score_together(self, images: Images, camera: Camera, level: Level) -> ShiftScores:
        """Score all images against their own clouds."""
        scores = self.score(images, camera, level)
        return concatenate_scores([each for each in scores if each is not None])

    def _score_frame(
        self, image: PreparedImage, frame: Frame, *, camera: Camera, level: Level, offset: int
    ) -> ShiftScores | None:
        other = self.dataset.neighbour(frame, offset) if offset else frame
        if other is None:
            return None
        most = MAX_WINDOWS // min(len(self.frames), SHARING_FRAMES)
        cloud, twist = self._cache.cloud(other), other.twist_per_s
        return score_frame(
            image, cloud, camera, level, frame=frame.index, max_windows=most, twist_per_s=twist
        )
