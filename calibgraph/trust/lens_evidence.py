"""Whether another lens fits the images better, with the pose free: a search, then two fits.

The posterior is that of :mod:`calibgraph.trust.lens_posterior`. Matches have followed a wrong lens,
so the search starts from the images. On KITTI 00 with a focal length 3 % off, the matches say
0.03 %, and the images 2.6 and 3.1 %. The second fit is linearized at the mean of the first, which
alone is sure of one of these two cameras.
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
from calibgraph.model.clock import clock_of
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.places import NOWHERE, Places
from calibgraph.model.rig import Camera
from calibgraph.solver.camera_twist import apply_twist
from calibgraph.solver.linear_fit import LinearFit, block_of, fit_camera
from calibgraph.solver.scan_distortion import distortion_fields_px
from calibgraph.trust.frame_scores import FINER, WIDE, FrameScorer, Images
from calibgraph.trust.lens_posterior import Free, LensPosterior, fields_px, free_of, lens_variable
from calibgraph.trust.thresholds import limit
from factors import displace

SEARCH_POSE = np.array([WIDE.rotation_rad] * 3 + [0.5] * 3)
"""Half-widths of a search; a focal length wrong by 5 % displaces a result by up to 0.5 m."""
SEARCH_LENS = 0.08, 0.15, 0.04, 0.08
"""The same of the logarithm of the focal length, of k1, of the principal point in focal
lengths, of the logarithm of fx / fy."""
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
) -> LensPosterior | None:
    """The posterior of the lens by the images, with the pose free; None where they do not tell.

    Args:
        scorer: of the frames.
        images: of the camera.
        camera: at the result.
        scores: of the camera at the level ``WIDE``.
        seed: of the search.
        places: which frames share one.
    """
    free = free_of(camera, is_timed=False)
    if not free:
        return None
    scores = _with_lens(scorer, camera, scores)
    best = _search(camera, scores, seed)
    rough = _fit_at_peaks(scorer, camera, scores, best, places=places)
    if rough is None or not (found := LensPosterior.of(camera, free, rough)).is_known:
        return None
    moved = np.append(found.mean[: Free.SKEW], 0.0)  # no lens has a skew
    refined = lens_variable(camera).put_into(
        apply_twist(camera, found.twist_at(moved)), moved[: Free.SKEW]
    )
    again = _with_lens(scorer, refined, scorer.score_together(images, refined, FINER))
    fine = _fit_at_peaks(scorer, refined, again, np.zeros(len(best)), places=places)
    if fine is None:
        return None
    # right shapes are nearer to zero without a finer fit, and wrong ones farther
    return replace(LensPosterior.of(camera, free, fine.counted_from(moved)), shapes=found.shapes)


def _with_lens(scorer: FrameScorer, camera: Camera, scores: ShiftScores) -> ShiftScores:
    """Scores with the lens as further unknowns, by points where they are when they are seen."""
    twists = {frame.index: frame.twist_per_s for frame in scorer.frames}
    known = {number: np.zeros(6) if one is None else one for number, one in twists.items()}
    of_groups = np.array([known[number] for number in scores.frame.tolist()]).reshape(-1, 6)
    times_s = clock_of(camera).times_s(scores.pixels_px[:, 1])
    points_m = displace(scores.points_lidar_m, of_groups, -times_s)
    return scores.with_unknowns(fields_px(camera, free_of(camera, is_timed=False), points_m))


def _search(camera: Camera, scores: ShiftScores, seed: int) -> Array:
    """The best twist and lens, (12,), by the scores at a result.

    A skew moves pixels too little for a search. Across the longer side of the image, a principal
    point cannot be told from a rotation.
    """
    along = Free.CENTRE_X if camera.width_px >= camera.height_px else Free.CENTRE_Y
    lens = Free.FOCAL, Free.RADIAL, along, Free.ASPECT
    columns = [*range(6), *(6 + number for number in lens)]
    units = np.array([1.0, 1.0, camera.intrinsics_px.fx, 1.0]) * SEARCH_LENS
    sigmas = np.array(lens_variable(camera).free.sigmas)[[*lens]]
    smooth = replace(
        scores,
        grids=np.stack([cv2.GaussianBlur(g, (0, 0), SEARCH_BLUR_STEPS) for g in scores.grids]),
        jacobian=np.ascontiguousarray(scores.jacobian[:, :, columns]),
    )
    widths = np.append(SEARCH_POSE, units / sigmas)
    best = np.zeros(scores.jacobian.shape[2])
    best[columns] = maximize_score(smooth, widths, seed=seed, prior=SEARCH_PRIOR)
    return best


def _fit_at_peaks(
    scorer: FrameScorer, camera: Camera, scores: ShiftScores, start: Array, *, places: Places
) -> LinearFit | None:
    """Fit pose and lens to the groups' peaks next to a start, (12,); the scan may be distorted."""
    if not len(scores.weights):
        return None
    table = extract_correspondences(scores, start, "camera")
    table = with_motion(table, scorer.dataset)
    block = block_of(camera, replace(table, frame=places.merge_stationary(table.frame)))
    usual = MatcherFindings.from_metadata({"matcher": "structure"})
    points, free = block.block.points_lidar_m, free_of(camera, is_timed=False)
    of_place = usual.place_variance * places.frames_per_place(block.frame_numbers)
    bends = distortion_fields_px(camera, points) * np.reshape(usual.bend_sigmas, (3, 1, 1))
    return fit_camera(
        camera,
        block,
        np.concatenate([fields_px(camera, free, points), bends]),
        shared_variance=max(of_place, limit("lens_match_share") * len(block)),
        considered=len(bends),
    )
