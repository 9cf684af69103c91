"""The matcher `structure` as the pipeline sees it: one table of correspondences per round."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.correspondences import Correspondences, concatenate
from calibgraph.dataset import Dataset, Frame
from calibgraph.rig import Camera, Rig
from calibgraph.structure.consensus import find_consensus
from calibgraph.structure.level import LEVELS, Level
from calibgraph.structure.peaks import correspondences_at_peaks
from calibgraph.structure.scores import Scores, joined, score_frame
from calibgraph.structure.windows import Cloud

if TYPE_CHECKING:
    from calibgraph.pipeline import Progress

SYSTEMATIC_ROTATION_RAD = float(np.radians(0.07))
SYSTEMATIC_TRANSLATION_M = 0.02
"""Error per axis that the frames of a scene share: its root mean square over recorded scenes of two
rigs, each from a few places. One place alone is worse; synthetic scenes are better."""

_NEAR_ROUNDS = (2, 4)
MAX_WINDOWS = 20_000  # per camera and round, over all frames: bounds the time, not the accuracy


class StructureMatcher:
    """Weight-free matching for initial errors of up to about 2.5 degrees and 25 cm.

    It remembers the decoded images and clouds of a dataset from round to round.

    Args:
        seed: of the pose search.
        levels: the rounds, coarse to fine.
    """

    stage1: Literal["pnp", "rig"] = "rig"

    def __init__(self, *, seed: int = 0, levels: Sequence[Level] = LEVELS) -> None:
        self.seed = seed
        self.levels = levels
        self.rounds = len(levels)
        self._clouds: dict[Path, Cloud] = {}
        self._images: dict[Path, NDArray[np.uint8]] = {}

    @property
    def tracking_rounds(self) -> tuple[int, ...]:
        """The rounds for starts that are off by up to 0.7 degrees and 20 cm."""
        return tuple(index for index in _NEAR_ROUNDS if index < self.rounds)

    def match(
        self, dataset: Dataset, rig: Rig, *, round_index: int, progress: Progress
    ) -> Correspondences:
        """Match every camera in every frame, from the rig's poses."""
        level = self.levels[round_index]
        work = len(rig.cameras) * len(dataset.frames)
        tables, contrasts = [], {}
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            for index, (name, camera) in enumerate(rig.cameras.items()):
                done = round_index * work + index * len(dataset.frames)
                what = f"round {round_index + 1} of {self.rounds}: {name}"
                progress(what, done, self.rounds * work)
                score = partial(
                    self._score, name, camera, level, MAX_WINDOWS // len(dataset.frames)
                )
                scores = joined(list(pool.map(score, dataset.frames)))
                twist, contrasts[name] = find_consensus(scores, level, seed=self.seed)
                tables.append(correspondences_at_peaks(scores, twist, name))
        settings = {
            "matcher": "structure",
            "round": round_index,
            "seed": self.seed,
            "contrast": contrasts,
            "range_rotation_deg": float(np.degrees(self.levels[0].rotation_rad)),
            "range_translation_m": self.levels[0].translation_m,
            "systematic_rotation_rad": SYSTEMATIC_ROTATION_RAD,
            "systematic_translation_m": SYSTEMATIC_TRANSLATION_M,
        }
        return replace(concatenate(tables), metadata=settings)

    def _score(self, name: str, camera: Camera, level: Level, most: int, frame: Frame) -> Scores:
        gray, cloud = self._image(frame, name, camera), self._cloud(frame)
        return score_frame(gray, cloud, camera, level, frame=frame.index, most=most)

    def _cloud(self, frame: Frame) -> Cloud:
        """The frame's cloud, decoded once."""
        if frame.cloud_path not in self._clouds:
            self._clouds[frame.cloud_path] = Cloud.of(frame.load_cloud())
        return self._clouds[frame.cloud_path]

    def _image(self, frame: Frame, name: str, camera: Camera) -> NDArray[np.uint8]:
        """The camera's gray image, decoded once."""
        path = frame.image_paths[name]
        if path not in self._images:
            image = cv2.cvtColor(frame.load_image(name, camera), cv2.COLOR_BGR2GRAY)
            self._images[path] = np.asarray(image, dtype=np.uint8)
        return self._images[path]
