"""What images and clouds say of a result when they are looked at once more, from its poses.

Per camera, with the score of :mod:`calibgraph.structure.scores`:

* whether another lens (focal length, radial distortion, principal point) fits the images better,
  with the pose free;
* whether the pose fits better than poses a degree or two, or some decimetres, away from it;
* whether each image fits its own cloud better than its neighbours' clouds.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.io.dataset import Dataset, Frame, spread_out
from calibgraph.matching.structure.consensus import chance_spread, search, summed_score
from calibgraph.matching.structure.peaks import correspondences_at_peaks
from calibgraph.matching.structure.schedule import LEVELS, Level
from calibgraph.matching.structure.shift_scores import Scores, joined, score_frame
from calibgraph.matching.structure.windows import Cloud
from calibgraph.model.rig import Camera, Rig
from calibgraph.progress import Progress, no_progress
from calibgraph.solver.augmented_fit import AugmentedFit, fit_augmented, moved_by

Array = NDArray[np.float64]

MAX_FRAMES = 20  # evenly spread over the dataset: bounds the time
MAX_WINDOWS, SHARING_FRAMES = 10_000, 10  # per camera, over so many frames; of more, as many each
MIN_GROUPS = 30  # fewer say nothing

WIDE, FINER = LEVELS[1], LEVELS[2]
SEARCH_M = 0.5  # a focal length wrong by 5 % displaces a result by up to this
SEARCH_LENS = (0.08, 0.15, 0.04)  # half-widths, see ImageEvidence.lens
MAX_RADIAL = 0.3
SEARCH_PRIOR = 1.0  # weak: the answer is to be unbiased
SEARCH_BLUR_STEPS = 1.0  # of the score grids, for the search only

TILTS_DEG, SHIFT_M = (1.2, 2.2), 0.4
"""How far the poses are displaced that a result must beat: about and along each axis."""

PAIR_LEVEL = replace(WIDE, reach_rad=np.radians(1.2))


@dataclass(frozen=True)
class ImageEvidence:
    """What the images say of one camera's result.

    Attributes:
        groups: groups of windows that were looked at; with fewer than MIN_GROUPS all else is NaN.
        lens: what must be added to the lens to fit best: to the logarithm of the focal length, to
            the first radial coefficient, to the principal point along the longer side of the image
            (in focal lengths).
        lens_sigmas: standard deviations of these by the scatter of the frames, lower bounds.
        gain: by how many chance spreads the best pose nearby, with its own lens, beats the pose.
        contrast: score at the pose, in standard deviations of those of displaced poses above
            their mean.
        frames_best: share of the frames that like the pose better than every displaced one.
        frames_lost: the numbers of the other frames.
        pair_offset: how many frames later the clouds are that fit the images best: -1, 0 or 1.
        pair_margin: by which share of the best the score with the own clouds is above the better
            of both neighbours', negative if it is below; NaN without neighbours.
    """

    groups: int
    lens: tuple[float, ...] = (math.nan,) * 3
    lens_sigmas: tuple[float, ...] = (math.nan,) * 3
    gain: float = math.nan
    contrast: float = math.nan
    frames_best: float = math.nan
    frames_lost: tuple[int, ...] = ()
    pair_offset: int = 0
    pair_margin: float = math.nan


def look_again(
    dataset: Dataset, rig: Rig, *, seed: int = 0, progress: Progress | None = None
) -> dict[str, ImageEvidence]:
    """Look at the images of all cameras from a rig's poses.

    Args:
        dataset: images and clouds.
        rig: lenses, and the poses in question.
        seed: of the search.
        progress: to be told how far it is.
    """
    report = progress or no_progress
    frames = spread_out(dataset.frames, MAX_FRAMES)
    evidence = {}
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        view = _View(dataset, frames, pool)
        for index, (name, camera) in enumerate(rig.cameras.items()):
            report(f"checking: {name}", index, len(rig.cameras))
            evidence[name] = _camera_evidence(view, name, camera, seed)
    return evidence


class _View:
    """Scores of some frames of a dataset, in parallel; clouds are decoded once."""

    def __init__(self, dataset: Dataset, frames: Sequence[Frame], pool: ThreadPoolExecutor) -> None:
        self.frames = frames
        self._dataset = dataset
        self._pool = pool
        self._clouds: dict[int, Cloud] = {}

    def images(self, name: str, camera: Camera) -> list[NDArray[np.uint8]]:
        """Gray images of a camera, one per frame."""
        return list(self._pool.map(lambda frame: frame.load_gray(name, camera), self.frames))

    def scores(
        self, images: Sequence[NDArray[np.uint8]], camera: Camera, level: Level, offset: int = 0
    ) -> list[Scores | None]:
        """Each image's scores with the cloud so many frames later; None where there is none."""
        one = partial(self._score, camera=camera, level=level, offset=offset)
        return list(self._pool.map(one, images, self.frames))

    def joined_scores(
        self, images: Sequence[NDArray[np.uint8]], camera: Camera, level: Level
    ) -> Scores:
        """The scores of all images with their own clouds."""
        return joined([s for s in self.scores(images, camera, level) if s is not None])

    def _score(
        self, gray: NDArray[np.uint8], frame: Frame, *, camera: Camera, level: Level, offset: int
    ) -> Scores | None:
        other = self._dataset.neighbour(frame, offset) if offset else frame
        if other is None:
            return None
        if other.index not in self._clouds:
            self._clouds[other.index] = Cloud.of(other.load_cloud())
        most = MAX_WINDOWS // min(len(self.frames), SHARING_FRAMES)
        cloud = self._clouds[other.index]
        return score_frame(gray, cloud, camera, level, frame=frame.index, most=most)


def _camera_evidence(view: _View, name: str, camera: Camera, seed: int) -> ImageEvidence:
    images = view.images(name, camera)
    scores = view.joined_scores(images, camera, WIDE)
    groups = len(scores.counts)
    if groups < MIN_GROUPS:
        return ImageEvidence(groups)
    found = _against_displaced(scores) | _lens(view, images, camera, scores, seed)
    return ImageEvidence(groups, **found, **_pairs(view, images, camera))


def _against_displaced(scores: Scores) -> dict[str, Any]:
    """The score at the pose against that at displaced poses, over the same windows."""
    frames = np.unique(scores.frame)
    twists = _displacements()
    per_frame = np.array([summed_score(_of_frame(scores, frame), twists) for frame in frames])
    own, displaced = per_frame[:, 0], per_frame[:, 1:]
    best = own > displaced.max(axis=1)
    total = displaced.sum(axis=0)
    return {
        "contrast": float((own.sum() - total.mean()) / (total.std() + 1e-12)),
        "frames_best": float(best.mean()),
        "frames_lost": tuple(frames[~best].tolist()),
    }


def _of_frame(scores: Scores, frame: int) -> Scores:
    rows = scores.frame == frame
    return replace(scores, grids=scores.grids[rows], flow=scores.flow[rows])


def _displacements() -> Array:
    """(n, 6) twists: none, then turns about and shifts along each axis, both ways."""
    turns = [np.radians(tilt) * sign for tilt in TILTS_DEG for sign in (-1, 1)]
    shifts = [SHIFT_M * sign for sign in (-1, 1)]
    axes = np.eye(6)
    twists = [axes[axis] * size for axis in range(3) for size in turns]
    twists += [axes[axis] * size for axis in range(3, 6) for size in shifts]
    return np.array([np.zeros(6), *twists])


def _lens(
    view: _View, images: Sequence[NDArray[np.uint8]], camera: Camera, scores: Scores, seed: int
) -> dict[str, Any]:
    """The lens that fits best, with the pose free: a search, then two fits."""
    box = np.array([WIDE.rotation_rad] * 3 + [SEARCH_M] * 3 + [*SEARCH_LENS])
    smooth = replace(
        scores,
        grids=np.stack([cv2.GaussianBlur(g, (0, 0), SEARCH_BLUR_STEPS) for g in scores.grids]),
        flow=_with_lens_flow(scores, camera),
    )
    best = search(smooth, box, seed=seed, prior=SEARCH_PRIOR)
    values = summed_score(smooth, np.array([np.zeros(9), best]))
    gain = float((values[1] - values[0]) / (chance_spread(smooth) + 1e-12))
    rough = _refined(camera, scores, best)
    if rough is None:
        return {"gain": gain}
    candidate = with_lens(moved_by(camera, rough.twist), rough.values)
    fine = _refined(candidate, view.joined_scores(images, candidate, FINER), np.zeros(9))
    if fine is None:
        return {"gain": gain}
    return {
        "lens": tuple((rough.values + fine.values).tolist()),
        "lens_sigmas": tuple(fine.sigmas.tolist()),
        "gain": gain,
    }


def _refined(camera: Camera, scores: Scores, start: Array) -> AugmentedFit | None:
    """Pose and lens from the groups' peaks next to a start."""
    if not len(scores.counts):
        return None
    wide = replace(scores, flow=_with_lens_flow(scores, camera))
    table = correspondences_at_peaks(wide, start, "camera")
    return fit_augmented(camera, table, lens_columns_px(camera, table.points_lidar_m))


def _with_lens_flow(scores: Scores, camera: Camera) -> Array:
    """(g, 2, 9) the flow in steps, by the twist and by the lens."""
    columns = lens_columns_px(camera, scores.points_lidar_m) * scores.steps_per_px[:, None]
    return np.concatenate([scores.flow, columns], axis=2)


def lens_columns_px(camera: Camera, points_lidar_m: Array) -> Array:
    """(n, 2, 3) derivatives of the pixels by the lens, see ``ImageEvidence.lens``."""
    T, k = camera.T_camera_lidar, camera.intrinsics_px
    pixels, _ = camera.lens.project(points_lidar_m @ T[:3, :3].T + T[:3, 3])
    focal = np.array([k.fx, k.fy])
    off = pixels - np.array([k.cx, k.cy])
    radius = np.linalg.norm(off / focal, axis=1, keepdims=True)
    centre = np.broadcast_to(focal * _longer_side(camera), off.shape)
    return np.stack([off, radius**2 * off, centre], axis=2)


def _longer_side(camera: Camera) -> Array:
    """(2,) unit vector along it. Across it a principal point is no different from a rotation."""
    return np.array([1.0, 0.0] if camera.width_px >= camera.height_px else [0.0, 1.0])


def with_lens(camera: Camera, change: Array) -> Camera:
    """The camera with another lens: by a change as in ``ImageEvidence.lens``."""
    k, scale = camera.intrinsics_px, math.exp(change[0])
    shift = change[2] * _longer_side(camera)
    distortion = [*camera.distortion, *[0.0] * (4 - len(camera.distortion))]
    distortion[0] += float(np.clip(change[1], -MAX_RADIAL, MAX_RADIAL))
    values = {key: getattr(camera, key) for key in type(camera).model_fields}
    values["intrinsics_px"] = k.model_copy(
        update={
            "fx": k.fx * scale,
            "fy": k.fy * scale,
            "cx": k.cx + shift[0] * k.fx,
            "cy": k.cy + shift[1] * k.fy,
        }
    )
    return Camera(**{**values, "distortion": tuple(distortion)})


def _pairs(view: _View, images: Sequence[NDArray[np.uint8]], camera: Camera) -> dict[str, Any]:
    """Each image with its own cloud, and with its neighbours' clouds."""
    values = np.array(
        [[_agreement(s) for s in view.scores(images, camera, PAIR_LEVEL, o)] for o in (-1, 0, 1)]
    )  # (3, frames); NaN where there is no such cloud
    asked = np.isfinite(values[1]) & np.isfinite(values[[0, 2]]).any(axis=0)
    if not asked.any():
        return {}
    before, own, after = values[:, asked]
    margins = [own - before, own - after]
    worse = int(np.argmin([np.nanmean(m) if np.isfinite(m).any() else np.inf for m in margins]))
    there = np.isfinite(margins[worse])
    sums = own[there].sum(), (before, after)[worse][there].sum()
    return {
        "pair_offset": 0 if sums[0] >= sums[1] else (-1, 1)[worse],
        "pair_margin": float((sums[0] - sums[1]) / (max(abs(sums[0]), abs(sums[1])) + 1e-12)),
    }


def _agreement(scores: Scores | None) -> float:
    """The summed score at the pose, in chance spreads; NaN if there is nothing to score."""
    if scores is None or not len(scores.counts):
        return math.nan
    return float(summed_score(scores, np.zeros((1, 6)))[0]) / (chance_spread(scores) + 1e-12)
