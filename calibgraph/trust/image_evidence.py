"""Image evidence: a second pass over images and clouds tests a result, its lens and the pairing.

Per camera, with the scores of :mod:`calibgraph.matching.structure.shift_scores`:

* whether the result agrees with the images better than poses a degree or two, or some decimetres,
  away from it;
* whether another lens fits the images better, with the pose free: a search, then two fits;
* whether each image fits its own cloud better than the clouds of neighbouring frames.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.matching.run import MatchingRun, with_motion
from calibgraph.matching.structure.consensus import (
    displaced_z_score,
    maximize_score,
    score_displaced,
    z_score,
)
from calibgraph.matching.structure.peaks import extract_correspondences
from calibgraph.matching.structure.schedule import LEVELS
from calibgraph.matching.structure.shift_scores import (
    ShiftScores,
    concatenate_scores,
    crop_grids,
)
from calibgraph.model.clock import clock_of
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.places import NOWHERE, Places
from calibgraph.model.rig import Camera, Rig
from calibgraph.model.verdict import TOLERANCE, Check
from calibgraph.parallel import Threads, core_pool
from calibgraph.progress import Progress, no_progress
from calibgraph.solver.columns import ColumnFit, apply_twist, block_of, fit_columns
from calibgraph.solver.lens import MATCH_SHARE
from calibgraph.trust.evidence import Found, grade_by_images
from calibgraph.trust.lens_parameter import (
    IMAGES,
    NAMES,
    Free,
    LensParameter,
    check_parameter,
    lens_variable,
)
from calibgraph.trust.pose_posterior import FrameScorer
from calibgraph.trust.thresholds import LENS_FRAMES_BEST, LENS_Z_SCORE, threshold
from factors import Columns, displace, fields_px
from factors.columns import DISTORTION

WIDE, FINER = LEVELS[1], LEVELS[2]
MAX_FRAMES = 20  # evenly spread over the dataset: bounds the time
MIN_GROUPS = 30  # fewer groups of windows are no evidence
PAIR_LEVEL = replace(WIDE, reach_rad=np.radians(1.2))


def check_images(  # noqa: PLR0913 - what is checked, and by what
    dataset: Dataset,
    rig: Rig,
    *,
    tolerance: tuple[float, float] = TOLERANCE,
    places: Places = NOWHERE,
    seed: int = 0,
    lens: bool = True,
    pairing: bool = True,
    progress: Progress | None = None,
) -> list[tuple[str, Check]]:
    """The checks of all cameras of a result: of the extrinsic, if asked of lens and pairing.

    At a wrong extrinsic the lens cannot be measured.
    """
    report, found = progress or no_progress, []
    frames = spread_out(dataset.frames, MAX_FRAMES)
    names = {frame.index: frame.name for frame in frames}
    with core_pool() as cores, Threads(len(rig.cameras)) as pool:
        scorer = FrameScorer(dataset, frames, cores)

        def check(name: str, camera: Camera) -> list[Check]:
            each = scorer.score(name, camera, WIDE)
            scores = concatenate_scores([one for one in each if one is not None])
            if (groups := len(scores.weights)) < MIN_GROUPS:
                text = (
                    f"the images could not be checked: only {groups} places with structure in both "
                    "image and cloud"
                )
                return [Check("image evidence", "WARN", text, groups)]
            numbers, per_frame = score_displaced(scores)  # over the same windows
            best = per_frame[:, 0] > per_frame[:, 1:].max(axis=1)
            displaced = displaced_z_score(per_frame)
            lost, row = ", ".join(names[n] for n in numbers[~best][:5]), threshold("frames_best")
            checks = [
                threshold("displaced_z_score").check(displaced),
                # A solve leaves out frames that fit another extrinsic, and the rest agrees.
                row.check(best.mean(), advice=f"{lost} fit another extrinsic better: {row.advice}"),
            ]
            is_near = displaced >= LENS_Z_SCORE and best.mean() > LENS_FRAMES_BEST
            if lens and is_near:
                measured = measure_lens(scorer, name, camera, scores, seed=seed, places=places)
                checks += [check_parameter(one, IMAGES, tolerance) for one in measured]
            return checks + (_check_pairing(scorer, name, camera, each) if pairing else [])

        checked = pool.map(check, rig.cameras, rig.cameras.values())
        for index, name in enumerate(rig.cameras):
            report(f"checking: {name}", index, len(rig.cameras))
            found += [(name, each) for each in next(checked)]
    return found


def _check_pairing(
    scorer: FrameScorer, name: str, camera: Camera, wide: Sequence[ShiftScores | None]
) -> list[Check]:
    """Whether each image agrees with its own cloud, at ``WIDE``, better than with the neighbours'.

    The value is the lead of its score over that with the better ones, as a share of the best. Of
    frames without neighbours there is no check.
    """
    before, after = (scorer.score(name, camera, PAIR_LEVEL, offset=offset) for offset in (-1, 1))
    own = [one and crop_grids(one, camera, PAIR_LEVEL) for one in wide]
    values = np.array([  # (3, frames) z-scores at the result; NaN where there is no such cloud
        [z_score(one, np.zeros(6)) if one and len(one.weights) else math.nan for one in all_of]
        for all_of in (before, own, after)
    ])  # fmt: skip
    comparable = np.isfinite(values[1]) & np.isfinite(values[[0, 2]]).any(axis=0)
    if not comparable.any():
        return []
    before_z, own_z, after_z = values[:, comparable]
    margins = [own_z - before_z, own_z - after_z]
    worse = int(np.argmin([np.nanmean(m) if np.isfinite(m).any() else np.inf for m in margins]))
    there = np.isfinite(margins[worse])
    own_sum, other = own_z[there].sum(), (before_z, after_z)[worse][there].sum()
    advice = (
        f"the images fit the clouds of the {('previous', 'next')[worse]} frame better; check which "
        "image belongs to which cloud, and their time stamps"
    )
    margin = (own_sum - other) / (max(abs(own_sum), abs(other)) + 1e-12)
    return [threshold("own_clouds").check(margin, advice=advice)]


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
    name: str,
    camera: Camera,
    scores: ShiftScores,
    *,
    seed: int,
    places: Places = NOWHERE,
) -> tuple[LensParameter, ...]:
    """The lens that fits the images best, with the pose free; empty where images do not tell.

    From a camera at the result and its scores there at the level ``WIDE``. Of the principal point,
    the coordinate along the longer side of the image is free.
    """
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
    again = _with_lens(scorer, refined, scorer.score_together(name, refined, FINER))
    rest = _fit_at_peaks(scorer, refined, again, np.zeros(len(best)), places=places)
    if rest is None:
        return ()
    fine, units, parameters = rest.counted_from(moved), np.array(lens.free.sigmas), []
    for what, number in zip(NAMES, searched, strict=True):
        fit, others = fine if number in finer else rough, [n for n in finer if n != number]
        of = LensParameter.of(what, units[[number]], fit.free(*others, number))
        parameters.append(of)
    return tuple(parameters)


def _with_lens(scorer: FrameScorer, camera: Camera, scores: ShiftScores) -> ShiftScores:
    """Scores with the lens as further unknowns, by points where they are when they are seen."""
    twists = {frame.index: frame.twist_per_s for frame in scorer.frames}
    known = {number: np.zeros(6) if one is None else one for number, one in twists.items()}
    of_groups = np.array([known[number] for number in scores.frame.tolist()]).reshape(-1, 6)
    times_s = clock_of(camera).times_s(scores.pixels_px[:, 1])
    points_m = displace(scores.points_lidar_m, of_groups, -times_s)
    free = lens_variable(camera).free
    return scores.with_unknowns(fields_px(points_m, camera.T_camera_lidar, free)[1][6:])


def _search(camera: Camera, scores: ShiftScores, lens: tuple[int, ...], seed: int) -> Array:
    """The best twist and lens, (11,), by scores at the result; some of the lens is searched."""
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
) -> ColumnFit | None:
    """Fit pose and lens to the groups' peaks next to a start, (11,); the scan may be distorted."""
    if not len(scores.weights):
        return None
    table = extract_correspondences(scores, start, "camera")
    table = with_motion(table, scorer.dataset)
    block = block_of(camera, replace(table, frame=places.merge_stationary(table.frame)))
    usual = MatcherFindings.from_metadata({"matcher": "structure"})
    of_place = usual.place_variance * places.frames_per_place(block.frame_numbers)
    lens = lens_variable(camera).free
    names, sigmas = (*lens.parameters, *DISTORTION), (*lens.sigmas, *usual.bend_sigmas)
    return fit_columns(
        block,
        camera.T_camera_lidar,
        Columns(camera.lens, names, sigmas),
        shared_variance=max(of_place, MATCH_SHARE * len(block)),
        considered=len(DISTORTION),
    )


def image_checks(run: MatchingRun) -> Found:
    """Whether the images agree with a result; nothing if there is no time left for them.

    They are scored as by the matcher ``structure``, which does not use all that other matchers use:
    the result of a matcher that does not fail on images gets warnings only. Of a solution with
    camera pairs, the one without them is checked: next to a camera with a wrong lens, a right one
    is moved, and at the wrong one's place the lens cannot be measured. Cameras that a search did
    not find have no pose to check. Not observable: a principal point wrong along the shorter side
    of the image (it is equivalent to a rotation).
    """
    table, config = run.correspondences, run.solution.config
    solved = run.solution.without_pairs().solved_rig.cameras
    cameras = {name: of for name, of in solved.items() if name not in table.findings.missed}
    if run.out_of_time or not cameras:
        return
    try:
        found = check_images(
            run.dataset, Rig(cameras=cameras), tolerance=config.tolerance, places=table.places,
            seed=config.seed, lens=not table.is_swept, progress=run.progress,
        )  # fmt: skip
    except (CalibrationError, OSError) as error:  # files that its matcher did not need
        check = Check("image evidence", "WARN", f"the images could not be checked: {error}")
        found = [(name, check) for name in solved]
    for name, check in found:
        yield name, grade_by_images(run, check)
