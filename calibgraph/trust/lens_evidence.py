"""Whether another lens fits the images better, with the pose free: a search, then two fits.

The lens is that of :mod:`calibgraph.trust.lens_parameter`; of the principal point, the coordinate
along the longer side of the image.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from calibgraph.arrays import Array
from calibgraph.matching.run import with_motion
from calibgraph.matching.structure.consensus import maximize_score
from calibgraph.matching.structure.peaks import extract_correspondences
from calibgraph.matching.structure.shift_scores import ShiftScores
from calibgraph.model.clock import at_pixels, clock_of
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.places import NOWHERE, Places
from calibgraph.model.rig import Camera
from calibgraph.solver.camera_twist import apply_twist
from calibgraph.solver.linear_fit import LinearFit, block_of, fit_camera
from calibgraph.solver.scan_distortion import distortion_fields_px
from calibgraph.trust.frame_scores import FINER, WIDE, FrameScorer, Images
from calibgraph.trust.lens_parameter import (
    NAMES,
    Free,
    LensParameter,
    lens_fields_px,
    lens_variable,
    units_of,
)
from calibgraph.trust.thresholds import limit
from factors import displace

SEARCH_POSE = np.array([WIDE.rotation_rad] * 3 + [0.5] * 3)
"""Half-widths of a search; a focal length wrong by 5 % displaces a result by up to 0.5 m."""
SEARCH_LENS = 0.08, 0.15, 0.04, 0.08
"""The same of the logarithm of the focal length, of k1, of the principal point in focal
lengths, of the logarithm of fx / fy."""
MAX_RADIAL = 0.3
SEARCH_PRIOR = 1.0  # weak: the estimate is to be unbiased
SEARCH_BLUR_STEPS = 1.0  # of the score grids, for the search only


def measure_lens(  # noqa: PLR0913 - what is measured, and by what
    scorer: FrameScorer,
    images: Images,
    camera: Camera,
    scores: ShiftScores,
    *,
    seed: int,
    places: Places = NOWHERE,
) -> tuple[LensParameter, ...]:
    """The lens that fits the images best, with the pose free; empty where images do not tell.

    Args:
        scorer: of the frames.
        images: of the camera.
        camera: at the result.
        scores: of the camera at the level ``WIDE``.
        seed: of the search.
        places: which frames share one.
    """
    if camera.model == "equirectangular":
        return ()  # its format determines it
    # Across the longer side of the image, a principal point cannot be told from a rotation.
    along = Free.CENTRE_X if camera.width_px >= camera.height_px else Free.CENTRE_Y
    finer = Free.FOCAL, Free.RADIAL, along  # right shapes are nearer to zero without a finer fit
    searched = *finer, Free.ASPECT
    scores = _with_lens(scorer, camera, scores)
    best = _search(camera, scores, searched, seed)
    rough = _fit_at_peaks(scorer, camera, scores, best, places=places)
    if rough is None:
        return ()
    change, lens, moved = rough.free(*finer), lens_variable(camera), np.zeros(len(Free))
    moved[[*finer]] = change.values
    most = MAX_RADIAL / lens.free.sigmas[Free.RADIAL]
    moved[Free.RADIAL] = np.clip(moved[Free.RADIAL], -most, most)
    refined = lens.put_into(apply_twist(camera, change.twist), moved)
    again = _with_lens(scorer, refined, scorer.score_together(images, refined, FINER))
    rest = _fit_at_peaks(scorer, refined, again, np.zeros(len(best)), places=places)
    if rest is None:
        return ()
    fine, units, parameters = rest.counted_from(moved), units_of(camera), []
    for name, number in zip(NAMES, searched, strict=True):
        fit, others = fine if number in finer else rough, [n for n in finer if n != number]
        of = LensParameter.of(name, units[[number]], fit.free(*others, number))
        parameters.append(of)
    return tuple(parameters)


def _with_lens(scorer: FrameScorer, camera: Camera, scores: ShiftScores) -> ShiftScores:
    """Scores with the lens as further unknowns, by points where they are when they are seen."""
    twists = {frame.index: frame.twist_per_s for frame in scorer.frames}
    known = {number: np.zeros(6) if one is None else one for number, one in twists.items()}
    of_groups = np.array([known[number] for number in scores.frame.tolist()]).reshape(-1, 6)
    times_s = clock_of(camera).times_s(scores.pixels_px[:, 1])
    points_m = displace(scores.points_lidar_m, of_groups, -times_s)
    return scores.with_unknowns(lens_fields_px(camera, points_m))


def _search(camera: Camera, scores: ShiftScores, lens: tuple[int, ...], seed: int) -> Array:
    """The best twist and lens, (11,).

    Args:
        camera: at the result.
        scores: there, with the lens.
        lens: numbers of its parameters that are searched.
        seed: of the search.
    """
    columns = [*range(6), *(6 + number for number in lens)]
    units = np.array([1.0, 1.0, camera.intrinsics_px.fx, 1.0]) * SEARCH_LENS
    sigmas = np.array(lens_variable(camera).free.sigmas)[[*lens]]
    smooth = replace(
        scores,
        grids=np.stack([cv2.GaussianBlur(g, (0, 0), SEARCH_BLUR_STEPS) for g in scores.grids]),
        jacobian=np.ascontiguousarray(scores.jacobian[:, :, columns]),
    )
    widths = np.append(SEARCH_POSE, units / sigmas)
    best = np.zeros(6 + len(Free))
    best[columns] = maximize_score(smooth, widths, seed=seed, prior=SEARCH_PRIOR)
    return best


def _fit_at_peaks(
    scorer: FrameScorer, camera: Camera, scores: ShiftScores, start: Array, *, places: Places
) -> LinearFit | None:
    """Fit pose and lens to the groups' peaks next to a start, (11,); the scan may be distorted."""
    if not len(scores.weights):
        return None
    table = extract_correspondences(scores, start, "camera")
    table = at_pixels(camera, with_motion(table, scorer.dataset))
    block = block_of(camera, replace(table, frame=places.merge_stationary(table.frame)))
    usual = MatcherFindings.from_metadata({"matcher": "structure"})
    points = block.block.points_lidar_m
    of_place = usual.place_variance * places.frames_per_place(block.frame_numbers)
    bends = distortion_fields_px(camera, points) * np.reshape(usual.bend_sigmas, (3, 1, 1))
    return fit_camera(
        camera,
        block,
        np.concatenate([lens_fields_px(camera, points), bends]),
        shared_variance=max(of_place, limit("lens_match_share") * len(block)),
        considered=len(bends),
    )
