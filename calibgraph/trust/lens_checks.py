"""Whether lens and clock are right, by matches: the posteriors of a free lens, and a free offset.

Wrong intrinsics leave a pattern in the residuals. Matches follow a wrong time as they follow a
wrong pose, so the matcher matches again with the offset free, and pose and offset are fitted to
these matches. Where the motion of the LiDAR is not known, neighbouring clouds are registered;
without stamps they are taken to be 0.1 s apart.

A constant motion straight ahead is equivalent to a camera that is mounted further ahead.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.special import softmax

from calibgraph.errors import CalibrationError
from calibgraph.io.bags import is_bag
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.io.frame import seconds_between
from calibgraph.matching.run import MatchingRun, with_motion
from calibgraph.model.clock import clock_of
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.lens import LensSigmas
from calibgraph.model.rig import Camera, Rig
from calibgraph.model.verdict import TOLERANCE, Check
from calibgraph.parallel import map_on_cores
from calibgraph.solver.columns import block_of, fit_columns
from calibgraph.solver.lens import MATCH_SHARE
from calibgraph.trust.evidence import Evidence, Found, grade_by_images
from calibgraph.trust.inputs import INTERVAL_S, MAX_FRAMES, registered_twists
from calibgraph.trust.lens_parameter import (
    IMAGES,
    RESIDUALS,
    TIME,
    Free,
    LensParameter,
    check_parameter,
    lens_variable,
)
from calibgraph.trust.thresholds import LENS_WRONG
from factors import Columns
from factors.columns import CLOCK, OFFSET

MIN_FRAMES = 4  # with fewer, a single frame decides
_TOLD_S, _TOLD_CM = 0.01, 0.1  # whose effect is told, if it has one


def offset_checks(evidence: Evidence) -> Found:
    """The offset of each camera by the matches of a table that comes with the LiDAR's motion."""
    solution, config = evidence.solution, evidence.solution.config
    table, variance = solution.correspondences, evidence.findings.place_variance
    if not {*CLOCK}.isdisjoint(config.estimate):
        return
    for name, fit in _fit_cameras(solution.solved_rig, table, variance):
        yield name, check_offset(fit, RESIDUALS, config.tolerance)


def asks_offset(run: MatchingRun) -> bool:
    """Whether the checks ask for the offset, and so for the motion: if it is not estimated."""
    is_free = not {*CLOCK}.isdisjoint(run.solution.config.estimate)
    return bool(run.matcher.tracking_rounds) and not (run.out_of_time or is_free)


def image_offset_checks(run: MatchingRun) -> Found:
    """The offset of each camera by matches that are made for it, unless it is estimated.

    By a matcher made for them, since that of the run has been released.
    """
    if not asks_offset(run) or run.correspondences.is_swept:
        return
    rig, moved, registered = run.solution.without_pairs().solved_rig, None, False
    with suppress(CalibrationError, OSError):  # the checks on images report it
        moved, registered = _with_known_motion(run.dataset)
    matcher = run.matcher.with_estimate(("offset",))
    if moved is None or matcher is run.matcher:
        return
    if registered:  # the result leaves out times where the motion is not known
        none = dict.fromkeys(("time_offset_s", "time_offset_sigma_s", "readout_s"))
        cameras = {name: each.model_copy(update=none) for name, each in rig.cameras.items()}
        rig = rig.model_copy(update={"cameras": cameras})
    table = matcher.match(
        moved, rig, round_index=matcher.tracking_rounds[-1], progress=run.progress
    )
    matcher.release()
    table = with_motion(table, moved).with_places(run.correspondences.places)
    options, tolerance = _motion_options(run.dataset) * registered, run.solution.config.tolerance
    is_told = registered and seconds_between(*moved.frames[:2]) is None
    taken = f"; successive clouds are taken to be {INTERVAL_S:g} s apart" * is_told
    for name, fit in _fit_cameras(rig, table, run.correspondences.findings.place_variance):
        check = check_offset(fit, IMAGES, tolerance, options)
        yield name, grade_by_images(run, replace(check, text=check.text + taken))


def _motion_options(dataset: Dataset) -> str:
    """The options with which scans show the motion of all frames."""
    frame = dataset.frames[0]
    if any(map(is_bag, dataset.folders)):
        return " --motion scans"
    near = dataset.neighbour(frame, 1)
    seconds = None if near is None else seconds_between(frame, near)
    return f" --interval-s {abs(seconds or INTERVAL_S):.3g}"


def _fit_cameras(
    rig: Rig, table: Correspondences, place_variance: float
) -> Iterator[tuple[str, LensParameter]]:
    for name, camera in rig.cameras.items() if table.twist_per_s is not None else ():
        if fit := fit_offset(camera, table.of_camera(name), place_variance):
            yield name, fit


def check_offset(
    found: LensParameter, by: str, tolerance: tuple[float, float] = TOLERANCE, options: str = ""
) -> Check:
    """The check of an offset; of one that is not determined, it tells how much depends on it."""
    check, size = check_parameter(found, by, tolerance, options), float(found.units[0] * found.size)
    if found.sigmas[0] < LENS_WRONG:
        return check
    text = "the time of the images is not determined by these data, and taken for right"
    if size and (moved_cm := _TOLD_S * found.moved[1] / size) > _TOLD_CM:
        text += f"; {1e3 * _TOLD_S:.0f} ms would move the camera by {moved_cm:.2g} cm"
    return replace(check, text=text)


def fit_offset(
    camera: Camera, table: Correspondences, place_variance: float
) -> LensParameter | None:
    """Pose and offset by one camera's matches, with the LiDAR's motion; None of too few.

    ``place_variance`` is what the matches of a place share, over that of independent ones.
    """
    if len(np.unique(table.frame)) < MIN_FRAMES:
        return None
    sigma_s = camera.time_offset_sigma_s or LensSigmas.calibrated(camera).offset_s
    free = Columns(camera.lens, (OFFSET,), (sigma_s,), clock_of(camera))
    places = table.places
    block = block_of(camera, replace(table, frame=places.merge_stationary(table.frame)))
    of_place = place_variance * places.frames_per_place(block.frame_numbers)
    shared = max(of_place, MATCH_SHARE * len(block))
    fit = fit_columns(block, camera.T_camera_lidar, free, shared_variance=shared)
    return None if fit is None else LensParameter.of(TIME, np.array([sigma_s]), fit.free(0))


def _with_known_motion(dataset: Dataset) -> tuple[Dataset | None, bool]:
    """Some frames with their motion, None of too few; whether scans show that of any of them."""
    found = registered_twists(dataset)
    chosen = spread_out(dataset.frames, MAX_FRAMES)
    frames = [
        replace(frame, twist=found[frame.index]) if frame.kept and frame.index in found else frame
        for frame in chosen
        if frame.index in found or frame.twist_per_s is not None
    ]
    return dataset.only(frames) if len(frames) >= MIN_FRAMES else None, bool(found)


_NUMBERS = {
    "focal length": (Free.FOCAL,), "principal point": (Free.CENTRE_X, Free.CENTRE_Y),
    "distortion": (Free.RADIAL,), "aspect ratio": (Free.ASPECT,),
}  # fmt: skip
_OF_RIGHT = {"principal point": 1.1}
"""What matches show of right lenses beyond their scatter, in standard deviations of a calibrated
one: of 70 cameras in rendered streets (groups 100 to 106 of ``benchmarks.accuracy.error_bars``)."""
_BY_SCENE = "focal length", "distortion"  # what they do to the pose differs between scenes
_MAX_MATCHES = 20_000  # evenly chosen: bounds the time


def intrinsics_checks(evidence: Evidence) -> Found:
    """Whether wrong intrinsics explain the residuals.

    By all matches, not only those within the gate. The variance of what the frames of a place share
    is taken for at least that of a small share of each match.
    """
    is_swept = evidence.solution.correspondences.is_swept  # which looks like a lens
    names = [] if is_swept else [*evidence.fitted_blocks]
    checks = map_on_cores(lambda name: _check_camera(evidence, name), names)
    yield from ((name, each) for name, of in zip(names, checks, strict=True) for each in of)


def _check_camera(evidence: Evidence, name: str) -> list[Check]:
    solution, block = evidence.solution.without_pairs(), evidence.fitted_blocks[name]
    camera, places = solution.solved_rig.cameras[name], solution.correspondences.places
    of_place = places.frames_per_place(block.frame_numbers) * evidence.findings.place_variance
    some, lens = block.select_evenly(_MAX_MATCHES), lens_variable(camera).free
    seen = some.select(np.isfinite(some.all_sizes(camera.T_camera_lidar[None])[0]))
    fit = fit_columns(
        seen,
        camera.T_camera_lidar,
        lens,
        loss_scale=solution.scales[name].loss_scale,
        shared_variance=max(of_place, MATCH_SHARE * len(some)),
    )
    if fit is None:
        return []
    units, singles = np.array(lens.sigmas), {n: of for n, of in _NUMBERS.items() if len(of) == 1}
    freed = dict(zip(singles, fit.free_each([*singles.values()]), strict=True))
    found = [
        LensParameter.of(n, units[[*of]], freed.get(n) or fit.free(*of), _OF_RIGHT.get(n, 0.0))
        for n, of in _NUMBERS.items()
    ]
    blames = softmax([each.evidence for each in found]).tolist()
    return [
        check_parameter(
            each, RESIDUALS, solution.config.tolerance, blame=blame, unseen=each.name in _BY_SCENE
        )
        for each, blame in zip(found, blames, strict=True)
    ]
