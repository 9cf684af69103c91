"""Whether another lens fits the images better, with the pose free.

A change of the lens is (5,): what is added to the logarithm of the focal length, to the first
radial coefficient, to the principal point along the longer side of the image (in focal lengths),
to the logarithm of fx / fy, and to the skew (in parts of fx; half of it is a rotation about the
axis). Across that side, a principal point cannot be told from a rotation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.matching.structure.consensus import maximize_score, sum_scores
from calibgraph.matching.structure.peaks import extract_correspondences
from calibgraph.matching.structure.shift_scores import ShiftScores
from calibgraph.model.error_components import error_components
from calibgraph.model.places import NOWHERE, Places
from calibgraph.model.rig import Camera
from calibgraph.solver.augmented_fit import AugmentedFit, fit_augmented
from calibgraph.solver.camera_twist import apply_twist
from calibgraph.trust.frame_scores import FINER, WIDE, FrameScorer, Images
from calibgraph.trust.lens_parameter import NAMES, LensParameter

Array = NDArray[np.float64]
SEARCH_M = 0.5  # a focal length wrong by 5 % displaces a result by up to this
SEARCH_LENS = (0.08, 0.15, 0.04, 0.08)  # half-widths of the change of the lens
MAX_RADIAL = 0.3
_TO_CENTRE, _TO_ASPECT = 3, 4  # numbers of the lens that are searched: the first so many
SEARCH_PRIOR = 1.0  # weak: the estimate is to be unbiased
SEARCH_BLUR_STEPS = 1.0  # of the score grids, for the search only


@dataclass(frozen=True)
class LensEvidence:
    """The lens that fits the images best.

    Attributes:
        parameters: those of ``NAMES``, changed as above; none where images do not determine them.
        gain: of the summed score at the best pose nearby with its own lens over that at the result,
            in standard deviations of chance agreement.
    """

    parameters: tuple[LensParameter, ...] = ()
    gain: float = math.nan


def measure_lens(  # noqa: PLR0913 - what is measured, and by what
    scorer: FrameScorer,
    images: Images,
    camera: Camera,
    scores: ShiftScores,
    *,
    seed: int,
    places: Places = NOWHERE,
) -> LensEvidence:
    """Find the lens that fits the images best, with the pose free: a search, then two fits.

    Args:
        scorer: of the frames.
        images: of the camera.
        camera: at the result.
        scores: of the camera at the level ``WIDE``.
        seed: of the search.
        places: which frames share one.
    """
    frames = np.unique(scores.frame)
    copies = len(frames) / len(np.unique(places.merge_stationary(frames)))
    searched = 0 if camera.model == "equirectangular" else _TO_CENTRE  # the format determines it
    best, gain = _search(camera, scores, searched, seed)
    gain /= math.sqrt(copies)  # chance agreement of copies repeats
    if not searched:  # the pose alone is free
        return LensEvidence(gain=gain)
    shape = _shape(camera, scores, seed, places)
    rough = _fit_at_peaks(camera, scores, best, places)
    if rough is None:
        return LensEvidence(gain=gain)
    refined = change_lens(apply_twist(camera, rough.twist), np.append(rough.values, 0.0))
    finer = scorer.score_together(images, refined, FINER)
    fine = _fit_at_peaks(refined, finer, np.zeros(9), places)
    if fine is None:
        return LensEvidence(gain=gain)
    together = replace(fine, values=rough.values + fine.values)
    found = [_parameter(name, together, number) for number, name in enumerate(NAMES[:_TO_CENTRE])]
    return LensEvidence((*found, *shape), gain)


def _parameter(name: str, fit: AugmentedFit, number: int) -> LensParameter:
    value, sigma = fit.values[number : number + 1], fit.sigmas[number : number + 1]
    return LensParameter(name, value, sigma, np.ones(1), fit.compensating[:, number] * value)


def _search(camera: Camera, scores: ShiftScores, lens: int, seed: int) -> tuple[Array, float]:
    """The best twist and change of the lens, (6 + lens,), and its gain over a free pose alone."""
    half_widths = np.array([WIDE.rotation_rad] * 3 + [SEARCH_M] * 3 + [*SEARCH_LENS[:lens]])
    smooth = replace(
        scores,
        grids=np.stack([cv2.GaussianBlur(g, (0, 0), SEARCH_BLUR_STEPS) for g in scores.grids]),
        jacobian=_jacobian_with_lens(scores, camera, lens),
    )
    best = maximize_score(smooth, half_widths, seed=seed, prior=SEARCH_PRIOR)
    values = sum_scores(smooth, np.array([np.zeros(len(best)), best]))
    return best, float((values[1] - values[0]) / (smooth.chance_sigma + 1e-12))


def _shape(camera: Camera, scores: ShiftScores, seed: int, places: Places) -> list[LensParameter]:
    """Changes of the logarithm of fx / fy and of the skew.

    Measured apart from the others, which they would make less certain, and without a finer fit: on
    KITTI right ones are then nearer to zero. A skew moves pixels too little to be searched for.
    """
    best, _ = _search(camera, scores, _TO_ASPECT, seed)
    starts = (best, np.append(best, 0.0))
    fits = [_fit_at_peaks(camera, scores, start, places) for start in starts]
    return [
        _parameter(name, fit, len(fit.values) - 1)
        for name, fit in zip(NAMES[_TO_CENTRE:], fits, strict=True)
        if fit is not None
    ]


def lens_jacobian_px(camera: Camera, points_lidar_m: Array) -> Array:
    """(n, 2, 5) derivatives of the pixels of points (n, 3) by a change of the lens [px]."""
    T, k = camera.T_camera_lidar, camera.intrinsics_px
    pixels, _ = camera.lens.project(points_lidar_m @ T[:3, :3].T + T[:3, 3])
    focal = np.array([k.fx, k.fy])
    off_centre = pixels - np.array([k.cx, k.cy])
    radius = np.linalg.norm(off_centre / focal, axis=1, keepdims=True)
    centre = np.broadcast_to(focal * _longer_side(camera), off_centre.shape)
    aspect = off_centre * [0.5, -0.5]
    skew = 0.5 * off_centre[:, ::-1] * (focal / focal[::-1])
    return np.stack([off_centre, radius**2 * off_centre, centre, aspect, skew], axis=2)


def change_lens(camera: Camera, change: Array) -> Camera:
    """The camera with its lens changed by (4,), see above: no lens of a rig has a skew."""
    k = camera.intrinsics_px
    of_x, of_y = np.exp(change[0] + change[3] * np.array([0.5, -0.5])).tolist()
    shift = change[2] * _longer_side(camera)
    distortion = [*camera.distortion, *[0.0] * (4 - len(camera.distortion))]
    first_radial = int(camera.model == "omnidirectional")  # after xi
    distortion[first_radial] += float(np.clip(change[1], -MAX_RADIAL, MAX_RADIAL))
    values = {key: getattr(camera, key) for key in type(camera).model_fields}
    values["intrinsics_px"] = k.model_copy(
        update={
            "fx": k.fx * of_x,
            "fy": k.fy * of_y,
            "cx": k.cx + shift[0] * k.fx,
            "cy": k.cy + shift[1] * k.fy,
        }
    )
    return Camera(**{**values, "distortion": tuple(distortion)})


def _fit_at_peaks(
    camera: Camera, scores: ShiftScores, start: Array, places: Places
) -> AugmentedFit | None:
    """Fit pose and lens to the groups' peaks next to a start, (9,) to (11,)."""
    if not len(scores.weights):
        return None
    lens = len(start) - 6
    extended = replace(scores, jacobian=_jacobian_with_lens(scores, camera, lens))
    table = extract_correspondences(extended, start, "camera")
    table = replace(table, frame=places.merge_stationary(table.frame))
    jacobian_px = lens_jacobian_px(camera, table.points_lidar_m)[:, :, :lens]
    variance = error_components().matchers["structure"].place_variance
    shared = variance * places.frames_per_place(np.unique(table.frame))
    return fit_augmented(camera, table, jacobian_px, shared_variance=shared)


def _jacobian_with_lens(scores: ShiftScores, camera: Camera, lens: int) -> Array:
    """(g, 2, 6 + lens) derivatives of the shifts in steps by the twist and by the lens."""
    by_lens = (
        lens_jacobian_px(camera, scores.points_lidar_m)[:, :, :lens] * scores.steps_per_px[:, None]
    )
    return np.concatenate([scores.jacobian, by_lens], axis=2)


def _longer_side(camera: Camera) -> Array:
    """(2,) unit vector along the longer side of the image."""
    return np.array([1.0, 0.0] if camera.width_px >= camera.height_px else [0.0, 1.0])
