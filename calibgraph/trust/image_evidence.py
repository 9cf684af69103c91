"""Image evidence: a second pass over images and clouds tests a result.

Per camera, with the scores of :mod:`calibgraph.matching.structure.shift_scores`:

* whether the result agrees with the images better than poses a degree or two, or some decimetres,
  away from it;
* whether another lens fits the images better (:mod:`calibgraph.trust.lens_evidence`);
* whether each image fits its own cloud better than the clouds of neighbouring frames.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.matching.structure.consensus import displaced_z_score, score_displaced, z_score
from calibgraph.matching.structure.shift_scores import (
    ShiftScores,
    concatenate_scores,
    crop_grids,
)
from calibgraph.model.places import NOWHERE, Places
from calibgraph.model.rig import Camera, Rig
from calibgraph.parallel import Threads, core_pool
from calibgraph.progress import Progress, no_progress
from calibgraph.trust.frame_scores import WIDE, FrameScorer, Images
from calibgraph.trust.lens_evidence import measure_lens
from calibgraph.trust.lens_parameter import LensParameter

MAX_FRAMES = 20  # evenly spread over the dataset: bounds the time
MIN_GROUPS = 30  # fewer groups of windows are no evidence

PAIR_LEVEL = replace(WIDE, reach_rad=np.radians(1.2))


@dataclass(frozen=True)
class ImageEvidence:
    """Image evidence on one camera's result.

    Attributes:
        groups: groups of windows that were scored; with fewer than MIN_GROUPS all else is NaN.
        lens: how the lens that fits best differs; none where images do not determine it.
        displaced_z_score: score at the result less the mean score of the displaced poses, in
            standard deviations of the latter.
        frames_best: share of the frames whose score is highest at the result.
        frames_lost: the numbers of the other frames.
        pair_offset: by how many frames the clouds that fit the images best are later: -1, 0 or 1.
        pair_margin: lead of the score with the own clouds over the better of the two neighbours',
            as a share of the best; negative if a neighbour is better, NaN without neighbours.
    """

    groups: int
    lens: tuple[LensParameter, ...] = ()
    displaced_z_score: float = math.nan
    frames_best: float = math.nan
    frames_lost: tuple[int, ...] = ()
    pair_offset: int = 0
    pair_margin: float = math.nan


def measure_image_evidence(
    dataset: Dataset,
    rig: Rig,
    *,
    places: Places = NOWHERE,
    seed: int = 0,
    extrinsics_only: bool = False,
    progress: Progress | None = None,
) -> dict[str, ImageEvidence]:
    """Measure the image evidence on all cameras of a result."""
    report = progress or no_progress
    frames = spread_out(dataset.frames, MAX_FRAMES)
    evidence = {}
    with core_pool() as cores, Threads(len(rig.cameras)) as pool:
        scorer = FrameScorer(dataset, frames, cores)
        measure = partial(_measure_camera, scorer, seed=seed, places=places)
        if extrinsics_only:
            measure = partial(_measure_extrinsic, scorer)
        measured = pool.map(measure, rig.cameras, rig.cameras.values())
        for index, name in enumerate(rig.cameras):
            report(f"checking: {name}", index, len(rig.cameras))
            evidence[name] = next(measured)
    return evidence


def _measure_extrinsic(scorer: FrameScorer, name: str, camera: Camera) -> ImageEvidence:
    scores = scorer.score_together(scorer.load_images(name, camera), camera, WIDE)
    groups = len(scores.weights)
    if groups < MIN_GROUPS:
        return ImageEvidence(groups)
    return ImageEvidence(groups, **_compare_with_displaced(scores))


def _measure_camera(
    scorer: FrameScorer, name: str, camera: Camera, *, seed: int, places: Places
) -> ImageEvidence:
    images = scorer.load_images(name, camera)
    each = scorer.score(images, camera, WIDE)
    scores = concatenate_scores([one for one in each if one is not None])
    groups = len(scores.weights)
    if groups < MIN_GROUPS:
        return ImageEvidence(groups)
    return ImageEvidence(
        groups,
        lens=measure_lens(scorer, images, camera, scores, seed=seed, places=places),
        **_compare_with_displaced(scores),
        **_compare_with_neighbours(scorer, images, camera, each),
    )


def _compare_with_displaced(scores: ShiftScores) -> dict[str, Any]:
    """Compare the score at the result with displaced poses, over the same windows."""
    frames, per_frame = score_displaced(scores)
    best = per_frame[:, 0] > per_frame[:, 1:].max(axis=1)
    return {
        "displaced_z_score": displaced_z_score(per_frame),
        "frames_best": float(best.mean()),
        "frames_lost": tuple(frames[~best].tolist()),
    }


def _compare_with_neighbours(
    scorer: FrameScorer, images: Images, camera: Camera, wide: Sequence[ShiftScores | None]
) -> dict[str, Any]:
    """Compare each image's agreement with its own cloud and with its neighbours' clouds.

    Args:
        scorer: of the frames.
        images: of the camera.
        camera: at the result.
        wide: scores of the images with their own clouds, at ``WIDE``.
    """
    before, after = (scorer.score(images, camera, PAIR_LEVEL, offset=offset) for offset in (-1, 1))
    own = [one and crop_grids(one, camera, PAIR_LEVEL) for one in wide]
    values = np.array([[_agreement(one) for one in all_of] for all_of in (before, own, after)])
    # (3, frames); NaN where there is no such cloud
    comparable = np.isfinite(values[1]) & np.isfinite(values[[0, 2]]).any(axis=0)
    if not comparable.any():
        return {}
    before_z, own_z, after_z = values[:, comparable]
    margins = [own_z - before_z, own_z - after_z]
    worse = int(np.argmin([np.nanmean(m) if np.isfinite(m).any() else np.inf for m in margins]))
    there = np.isfinite(margins[worse])
    sums = own_z[there].sum(), (before_z, after_z)[worse][there].sum()
    return {
        "pair_offset": 0 if sums[0] >= sums[1] else (-1, 1)[worse],
        "pair_margin": float((sums[0] - sums[1]) / (max(abs(sums[0]), abs(sums[1])) + 1e-12)),
    }


def _agreement(scores: ShiftScores | None) -> float:
    """The z-score at the result; NaN if there is nothing to score."""
    if scores is None or not len(scores.weights):
        return math.nan
    return z_score(scores, np.zeros(6))
