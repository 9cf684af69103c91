"""Whether another lens fits the images better, with the pose free: a search, then two fits.

The lens is that of :mod:`calibgraph.trust.lens_parameter`; of the principal point, the coordinate
along the longer side of the image. Across that side it cannot be told from a rotation.
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
from calibgraph.solver.camera_twist import apply_twist
from calibgraph.solver.linear_fit import Freed, LinearFit, fit_table
from calibgraph.trust.frame_scores import FINER, WIDE, FrameScorer, Images
from calibgraph.trust.lens_parameter import (
    ASPECT_NUMBER,
    FOCAL_NUMBER,
    NAMES,
    RADIAL_NUMBER,
    SKEW_NUMBER,
    X_NUMBER,
    Y_NUMBER,
    LensParameter,
    lens_fields_px,
    lens_variable,
)

Array = NDArray[np.float64]
SEARCH_M = 0.5  # a focal length wrong by 5 % displaces a result by up to this
SEARCH_LENS = 0.08, 0.15, 0.04, 0.08
"""Half-widths: of the logarithm of the focal length, of k1, of the principal point in focal
lengths, of the logarithm of fx / fy."""
MAX_RADIAL = 0.3
_FINER = 3  # parameters that a finer fit makes better: without it right shapes are nearer to zero
SEARCH_PRIOR = 1.0  # weak: the estimate is to be unbiased
SEARCH_BLUR_STEPS = 1.0  # of the score grids, for the search only


@dataclass(frozen=True)
class LensEvidence:
    """The lens that fits the images best.

    Attributes:
        parameters: those of ``NAMES``; none where images do not determine them.
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
    """Find the lens that fits the images best, with the pose free.

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
    best, gain = _search(camera, scores, seed)
    found = LensEvidence(gain=gain / math.sqrt(copies))  # chance agreement of copies repeats
    if camera.model == "equirectangular":
        return found
    rough = _fit_at_peaks(camera, scores, best, places)
    if rough is None:
        return found
    change = rough.free(*range(_FINER))
    refined = _change(camera, change)
    finer = scorer.score_together(images, refined, FINER)
    fine = _fit_at_peaks(refined, finer, np.zeros(len(best)), places)
    if fine is None:
        return found
    of_rest = fine.free(*range(_FINER))
    together = replace(of_rest, values=change.values + of_rest.values)
    fits = [*[together] * _FINER, rough.free(0, 1, 2, 3), rough.free(0, 1, 2, 4)]
    numbers = _numbers(camera)
    parameters = tuple(
        LensParameter.of(name, camera, fit.only(min(row, _FINER)), (numbers[row],))
        for row, (name, fit) in enumerate(zip(NAMES, fits, strict=True))
    )
    return replace(found, parameters=parameters)


def _numbers(camera: Camera) -> tuple[int, ...]:
    """Of the parameters that are free, as of ``NAMES``; of a panorama the format determines all."""
    if camera.model == "equirectangular":
        return ()
    along = X_NUMBER if camera.width_px >= camera.height_px else Y_NUMBER
    return FOCAL_NUMBER, RADIAL_NUMBER, along, ASPECT_NUMBER, SKEW_NUMBER


def _fields_px(camera: Camera, points_lidar_m: Array) -> Array:
    """(k, 2, n) derivatives of the pixels of points (n, 3) by the parameters."""
    numbers = _numbers(camera)
    if not numbers:
        return np.zeros((0, 2, len(points_lidar_m)))
    return lens_fields_px(camera, points_lidar_m)[[*numbers]]


def _extend(scores: ShiftScores, camera: Camera) -> ShiftScores:
    """The scores, with the derivatives of the shifts in steps by the parameters, too."""
    fields = _fields_px(camera, scores.points_lidar_m).transpose(2, 1, 0)
    jacobian = np.concatenate([scores.jacobian, fields * scores.steps_per_px[:, None]], axis=2)
    return replace(scores, jacobian=jacobian)


def _search(camera: Camera, scores: ShiftScores, seed: int) -> tuple[Array, float]:
    """The best twist and lens, (6 + k,), and its gain over the result; the skew stays zero.

    A skew moves pixels too little to be searched for.
    """
    numbers = _numbers(camera)[:-1]
    widths = np.array([WIDE.rotation_rad] * 3 + [SEARCH_M] * 3 + [0.0] * len(numbers))
    if numbers:
        focal_px, sigmas = camera.intrinsics_px.fx, lens_variable(camera).free.sigmas
        widths[6:] = np.multiply(SEARCH_LENS, [1.0, 1.0, focal_px, 1.0])
        widths[6:] /= np.array(sigmas)[[*numbers]]
    extended = _extend(scores, camera)
    smooth = replace(
        scores,
        grids=np.stack([cv2.GaussianBlur(g, (0, 0), SEARCH_BLUR_STEPS) for g in scores.grids]),
        jacobian=np.ascontiguousarray(extended.jacobian[:, :, : len(widths)]),
    )
    best = maximize_score(smooth, widths, seed=seed, prior=SEARCH_PRIOR)
    values = sum_scores(smooth, np.array([np.zeros(len(best)), best]))
    gain = float((values[1] - values[0]) / (smooth.chance_sigma + 1e-12))
    return np.append(best, np.zeros(extended.jacobian.shape[2] - len(best))), gain


def _fit_at_peaks(
    camera: Camera, scores: ShiftScores, start: Array, places: Places
) -> LinearFit | None:
    """Fit pose and lens to the groups' peaks next to a start, (6 + k,)."""
    if not len(scores.weights):
        return None
    table = extract_correspondences(_extend(scores, camera), start, "camera")
    table = replace(table, frame=places.merge_stationary(table.frame))
    variance = error_components().matchers["structure"].place_variance
    shared = variance * places.frames_per_place(np.unique(table.frame))
    fields = _fields_px(camera, table.points_lidar_m)
    return fit_table(camera, table, fields, shared_variance=shared)


def _change(camera: Camera, change: Freed) -> Camera:
    """The camera at the twist and the first parameters of a fit."""
    lens = lens_variable(camera)
    values = np.zeros(len(lens.free))
    values[[*_numbers(camera)[:_FINER]]] = change.values
    most = MAX_RADIAL / lens.free.sigmas[RADIAL_NUMBER]
    values[RADIAL_NUMBER] = np.clip(values[RADIAL_NUMBER], -most, most)
    return lens.put_into(apply_twist(camera, change.twist), values)
