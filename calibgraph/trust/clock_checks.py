"""Whether images are taken when their clouds are: the posterior of a free offset.

Matches follow a wrong time as they follow a wrong pose, so the matcher matches again with the
offset free; the posterior of lens and clock is by these matches. Where the motion of the LiDAR is
not known, neighbouring clouds are registered; without stamps they are taken to be 0.1 s apart.

A constant motion straight ahead is equivalent to a camera that is mounted further ahead.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError, DatasetError
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.io.frame import Frame, ScanSteps, seconds_between, twist_by_scans
from calibgraph.io.kept_frames import KeptFrame
from calibgraph.matching.run import with_motion
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Camera, Rig
from calibgraph.model.verdict import Check
from calibgraph.solver.linear_fit import block_of
from calibgraph.trust.evidence import Checks
from calibgraph.trust.intrinsics import MIN_FRAMES, fit_lens
from calibgraph.trust.lens_checks import IMAGES, KINDS, check_lens
from calibgraph.trust.lens_posterior import TIME
from calibgraph.trust.run_evidence import RunEvidence
from factors.free_lens import CLOCK

INTERVAL_S = 0.1  # between clouds, where they have no stamps
MAX_STEPS = 10  # between the numbers of neighbouring clouds, if it is clouds that they count
MAX_FRAMES = 10  # evenly spread: bounds the time
_JERK, _JERK_M_S = 0.2, 1.0  # share and size by which the speeds to both neighbours may differ


def image_offset_checks(evidence: RunEvidence) -> Checks:
    """The offset of each camera by matches that are made for it, unless it is estimated.

    By a matcher made for them, since that of the run has been released.
    """
    run, config = evidence.run, evidence.run.solution.config
    if run.out_of_time or not {*CLOCK}.isdisjoint(config.estimate):
        return {}
    rig, moved, registered = run.solution.without_pairs().solved_rig, None, False
    with suppress(CalibrationError, OSError):  # the checks on images report it
        moved, registered = _with_known_motion(run.dataset)
    matcher = run.matcher.with_estimate(("offset",))
    if moved is None or not matcher.tracking_rounds or matcher is run.matcher:
        return {}
    if registered:
        rig = _without_times(rig)
    table = matcher.match(
        moved, rig, round_index=matcher.tracking_rounds[-1], progress=evidence.progress
    )
    matcher.release()
    table = with_motion(table, moved).with_places(run.correspondences.places)
    variance = run.correspondences.findings.place_variance
    checks = {
        name: _check_offset(camera, table.of_camera(name), variance, config)
        for name, camera in rig.cameras.items()
    }
    if registered and seconds_between(*moved.frames[:2]) is None:
        taken = f"; successive clouds are taken to be {INTERVAL_S:g} s apart"
        checks = {n: [replace(c, text=c.text + taken) for c in of] for n, of in checks.items()}
    return evidence.grade_by_images(checks)


def _check_offset(
    camera: Camera, rows: Correspondences, place_variance: float, config: Config
) -> list[Check]:
    """The check of the offset beside the lens, by one camera's matches; none of too few."""
    places = rows.places
    block = block_of(camera, replace(rows, frame=places.merge_stationary(rows.frame)))
    of_place = place_variance * places.frames_per_place(block.frame_numbers)
    found = fit_lens(camera, block, place_variance=of_place)
    if found is None:
        return []
    checks = check_lens(found, IMAGES, config.tolerance, config.estimate)
    return [check for check in checks if check.kind == KINDS[IMAGES][TIME]]


def _without_times(rig: Rig) -> Rig:
    """The rig without times, which the result leaves out where the motion is not known."""
    none = dict.fromkeys(("time_offset_s", "time_offset_sigma_s", "readout_s"))
    cameras = {name: each.model_copy(update=none) for name, each in rig.cameras.items()}
    return rig.model_copy(update={"cameras": cameras})


def _with_known_motion(dataset: Dataset) -> tuple[Dataset | None, bool]:
    """Some frames with their motion, None of too few; whether scans show that of any of them."""
    frames, registered, steps = [], False, ScanSteps()
    for frame in spread_out(dataset.frames, MAX_FRAMES):
        twist = frame.twist_per_s
        if twist is not None:
            frames.append(frame)
        elif (
            isinstance(frame, KeptFrame) and (found := _register(dataset, frame, steps)) is not None
        ):
            frames.append(replace(frame, twist=found))
            registered = True
    return dataset.only(frames) if len(frames) >= MIN_FRAMES else None, registered


def _register(dataset: Dataset, frame: Frame, steps: ScanSteps) -> Array | None:
    """(6,) the twist by both neighbours, if they are as far away as of one drive."""
    near = [dataset.neighbour(frame, sign) for sign in (-1, 1)]
    known = [(other, _later_s(frame, other)) for other in near if other is not None]
    if len(known) < len(near) or not all(later_s for _, later_s in known):
        return None
    try:
        before, after = (twist_by_scans(frame, [one], steps) for one in known)
    except DatasetError:  # they do not fit
        return None
    jerk = np.linalg.norm(after[3:] - before[3:])
    if jerk > _JERK * np.linalg.norm(after[3:]) + _JERK_M_S:
        return None
    return np.asarray((before + after) / 2)


def _later_s(frame: Frame, other: Frame) -> float:
    """How much later a neighbour was recorded: by stamps, or by the numbers of both clouds."""
    by_stamps = seconds_between(frame, other)
    if by_stamps is not None:
        return by_stamps
    stems = frame.cloud_path.stem, other.cloud_path.stem
    steps = int(stems[1]) - int(stems[0]) if all(map(str.isdecimal, stems)) else 0
    if not 0 < abs(steps) <= MAX_STEPS:  # other numbers, such as times
        steps = 1 if other.index > frame.index else -1
    return INTERVAL_S * steps
