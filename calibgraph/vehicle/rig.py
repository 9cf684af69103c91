"""The LiDARs of a rig from the frames of a dataset, with a verdict of each."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError, DatasetError
from calibgraph.io.bag_frames import scans_beside
from calibgraph.io.clouds import TIMES
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.io.frame import Frame, seconds_between
from calibgraph.matching.cloud_similarity import find_upright
from calibgraph.model.config import Config
from calibgraph.model.geometry import adjoints, invert, move_points, transform, twist_between
from calibgraph.model.rig import Rig, Vehicle
from calibgraph.model.verdict import ABOUT_THE_DATA, Check, Verdict
from calibgraph.progress import Progress
from calibgraph.trust.corrected import LOOKED_AT, TWICE, corrected_twice
from calibgraph.trust.probability import TABLES, judge, probability_beyond
from calibgraph.trust.thresholds import threshold
from calibgraph.vehicle.frame import Road, find_road, find_vehicle
from calibgraph.vehicle.lidars import (
    GUESS_SIGMAS,
    PLACE_SIGMAS,
    LidarPoses,
    calibrate_lidars,
    count_matched,
    join_poses,
    refine_poses,
)
from calibgraph.vehicle.motion import REACH_M, Drive, Instant
from calibgraph.vehicle.planes import Planes, View, Views, find_planes, look, thinned
from calibgraph.vehicle.start import distance_between, is_near, locate_lidars
from calibgraph.vehicle.sums import step_twists
from calibgraph.vehicle.travel import POSE_FILES, Travel, direction_of_travel, read_poses

MOST_INSTANTS = 20
"""Of a recording, spread over it: more hardly narrow what places differ by."""

MAP_SIGMAS = np.repeat([np.radians(0.1), 0.03], 3)
"""(6,) [rad, m]: prior of what the motion within a local map adds to a pose, as PLACE_SIGMAS."""
_COMMON_SIGMAS = np.repeat([0.0, 0.001 * REACH_M], 3)
"""(6,) [rad, m] that all maps share: of ranges that are 0.1 % too long."""
_HOW_TO_JOIN = (
    "or drive 150 m past walls, with times of points, and stamps in the names of clouds or in "
    "times.txt, so that LiDARs are joined by motion"
)
_CLOCK_FRAMES = 0.5
"""Standard deviation of the times of an instant's clouds, in steps between frames, where they are
not known: of clouds paired by stamps up to 0.5, of one that is a frame late 1."""
_CLOCK_M = 0.01  # from which a line states it
_SURE, _LONGER_M = 4.0, 0.005  # sigmas and metres of a difference of ranges that a line states
_PAIRS, _STEP_PLANES, _STEP_SHARE = 5, 1500, 0.9  # of neighbouring frames; of planes that must fit
_MOST_HALF_M = 500.0  # within which half of the points are
_ROUNDS = 2  # while it moves: clouds are brought to one time by the poses found
_LOOSE = 0.3  # sigma of an axis over that of the guess: planes hardly determine it
_OPEN = 0.98  # probability of an error by a bar alone: what is open is not known to be wrong
_EITHER = 0.5  # the same, where another pose fits as well
_AXES = ("roll x", "pitch y", "yaw z", "x", "y", "z")
_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class LidarResult:
    """What is found of a rig's LiDARs.

    Attributes:
        vehicle: the rig's, with T_vehicle_lidar and its sigmas; None if the rig has none.
        poses: of them.
        verdicts: per LiDAR but the base.
        warnings: about the instants and the start, a line each.
    """

    vehicle: Vehicle | None
    poses: LidarPoses
    verdicts: Mapping[str, Verdict]
    warnings: tuple[str, ...]


def calibrate_rig_lidars(
    dataset: Dataset,
    rig: Rig,
    config: Config,
    *,
    place: Callable[[str], LidarPoses] | None = None,
    progress: Progress,
) -> LidarResult:
    """The poses of a rig's LiDARs in its base, from clouds of instants.

    Where the vehicle is known to move, clouds are brought to one time by the points' times, or left
    out without these; else they are taken as they are, with wider error bars on a steady drive.

    Args:
        dataset: its frames have the clouds of all LiDARs; those that lack one are left out.
        rig: with the guess of each LiDAR, or none.
        config: the tolerance of the verdict.
        place: finds by cameras a LiDAR with a guess that planes do not determine.
        progress: called with the stage, its steps done, and their number.

    Raises:
        DatasetError: if no instant has all clouds.
        CalibrationError: if a LiDAR shares too little with others.
    """
    frames, warnings = _complete(dataset.frames, rig)
    names, files = (rig.lidar, *rig.other_lidars), product(dataset.folders, POSE_FILES)
    path = next((each for pair in files if (each := Path(*pair)).is_file()), None)
    progress("reading clouds of LiDARs", 0, 1)
    drive = Drive(frames, path)
    every = spread_out(range(len(frames)), MOST_INSTANTS)
    instants, lines = _usable([drive.instant(number, names) for number in every])
    warnings += lines
    guess = {name: rig.T_base_lidar.get(name) for name in rig.other_lidars}
    progress("locating LiDARs", 0, 1)
    views = _look(instants, guess, rig.lidar)
    start, doubts, lost = locate_lidars(views, guess, base=rig.lidar)
    parts, placed, reasons = list[LidarPoses](), dict[str, LidarPoses](), list[str]()
    if lost:
        progress("joining LiDARs by motion", 0, 1)
        far = {name: T for name, T in guess.items() if name not in start}
        try:
            poses, more, line = _join_by_motion(drive, instants, far, lost, base=rig.lidar)
            parts, doubts = [poses], doubts | more
        except CalibrationError:
            if any(T is None for T in far.values()):
                raise
            placed, reasons = _placed(far, place)
            missing = {name: T for name, T in far.items() if T is not None and name not in placed}
            begun, more, line = _begin(views, guess, missing, lost, base=rig.lidar)
            start, doubts = start | begun, doubts | more
        warnings += filter(None, [line])
    progress("calibrating LiDARs", 0, 1)
    if start:
        try:
            parts.append(_solve(instants, views, start, base=rig.lidar))
        except CalibrationError as error:
            raise CalibrationError("; ".join([*reasons, f"{error}"])) from error
        bars = parts[-1].covariance
        loose = [n for n in start if guess[n] is not None and _loose(bars[n], rig.lidar)]
        placed |= _placed(loose, place)[0]
    if placed:
        parts += placed.values()
        seen = f"placed by cameras that see what it and {rig.lidar} see"
        warnings.append(f"{', '.join(placed)}: {seen}")
    poses, late = _with_clock_errors(
        drive, instants, views[rig.lidar], join_poses(parts, [rig.lidar, *guess])
    )
    if rig.vehicle is not None:
        progress("finding the vehicle's frame", 0, 1)
    vehicle, unknown = _find_vehicle(rig.vehicle, instants, poses, path)
    twice = _corrected_twice(instants, poses.T_base_lidar)
    warnings += [*late, *unknown, *twice, *_unequal_ranges(poses)]
    for line in warnings:
        _log.warning(line)
    return LidarResult(
        vehicle,
        poses,
        {
            name: judge_lidar(
                poses, name, config.tolerance, doubt=doubts.get(name, ""), twice="; ".join(twice)
            )
            for name in rig.other_lidars
        },
        tuple(warnings),
    )


def _placed(
    names: Iterable[str], place: Callable[[str], LidarPoses] | None
) -> tuple[dict[str, LidarPoses], list[str]]:
    """The poses of LiDARs by cameras, without those that no camera is calibrated to; and why."""
    found, reasons = {}, []
    for name in names:
        try:
            if place is not None:
                found[name] = place(name)
        except CalibrationError as error:
            _log.info("%s", error)
            reasons.append(f"{error}")
    return found, reasons


def _begin(
    views: Views, guess: Mapping[str, Array | None], missing: Mapping[str, Array], lost: str, *,
    base: str,
) -> tuple[dict[str, Array], dict[str, str], str]:  # fmt: skip
    """The poses (4, 4) at which LiDARs are begun that do not fit their guess, doubts, and a line.

    That is where they fit without a guess, else the guess.
    """
    found, doubts = dict[str, Array](), dict[str, str]()
    if missing:
        with suppress(CalibrationError):  # no ground
            found, doubts, _ = locate_lidars(views, {**guess, **dict.fromkeys(missing)}, base=base)
    for name in missing.keys() & found.keys():
        degrees, metres = distance_between(found[name], missing[name])
        others = [n for n, T in guess.items() if T is not None and is_near(found[name], T)]
        why = f"does it have the clouds of {others[0]}?" if others else (
            "is that p_base = T_base_lidar * p_lidar, in metres, and are the clouds its own?"
        )  # fmt: skip
        doubts[name] = (
            f"it does not fit its guess, but turned by {degrees:.0f} deg and moved by "
            f"{metres:.1f} m from it: {why}"
        )
    if missing.keys() - found.keys():
        lost += "; begun from the guess"
    elif missing:
        lost = ""
    return {name: found.get(name, T) for name, T in missing.items()}, doubts, lost


def _look(instants: Sequence[Instant], guess: Mapping[str, Array | None], base: str) -> Views:
    T_base_lidar = {base: np.eye(4), **guess}
    views = look({n: [each.at_stamp(n, T) for each in instants] for n, T in T_base_lidar.items()})
    for name, of in views.items():
        half_m = np.median(np.concatenate([np.linalg.norm(v.points_m, axis=1) for v in of]))
        if half_m > _MOST_HALF_M:
            raise DatasetError(
                f"half of the points of LiDAR {name!r} are farther than {half_m:,.0f} m: write its "
                "clouds in metres"
            )
    return views


def _solve(
    instants: Sequence[Instant], views: Views, start: Mapping[str, Array], *, base: str,
    maps: Sequence[View] = (),
) -> LidarPoses:  # fmt: skip
    """The poses of LiDARs from a start, against local maps of the base if there are any."""
    moves, sigmas = any(each.twist_per_s is not None for each in instants), PLACE_SIGMAS
    for _ in range(_ROUNDS if moves else 1):
        if moves:
            views = _look(instants, start, base)
        seen = {base: maps or views[base], **{name: views[name] for name in start}}
        sigmas = MAP_SIGMAS if maps else PLACE_SIGMAS
        poses = calibrate_lidars(seen, start, base=base, place_sigmas=sigmas)
        start = {name: T for name, T in poses.T_base_lidar.items() if name != base}
    return poses


def _with_clock_errors(
    drive: Drive, instants: Sequence[Instant], seen: Sequence[View], poses: LidarPoses
) -> tuple[LidarPoses, list[str]]:
    """The poses, their error bars wider by what clouds of other times would do, and a line on it.

    Where the vehicle moves on steadily and its motion is not known, such clouds displace a LiDAR
    alike at all places, and no scatter shows it. As far as steps between frames differ, places do.
    Steps are by planes of the base.
    """
    is_stated = drive.frames[0].is_instant  # that clouds are of their stamps
    if is_stated or any(each.twist_per_s is not None for each in instants):
        return poses, []
    pairs = [
        (i.frame, view.planes)
        for i, view in zip(instants, seen, strict=True)
        if len(two := drive.frames[i.frame : i.frame + 2]) > 1
        and (seconds_between(*two) is None or scans_beside(two, 0))
    ]
    steps = [_step_after(drive, *pair, poses.base) for pair in spread_out(pairs, _PAIRS)]
    known = [step for step in steps if step is not None]
    if not known or len(known) < len(steps):
        return poses, []
    mean, apart = np.mean(known, axis=0), poses.places * np.var(known, axis=0)[3:].sum()
    frames = (_CLOCK_FRAMES**-2 + apart / (poses.place_ratios[1] * PLACE_SIGMAS[3] ** 2)) ** -0.5
    T = np.array([poses.T_base_lidar[name] for name in poses.covariance])
    each = frames * np.linalg.solve(step_twists(T), np.kron(np.eye(len(T)), mean[:, None]))
    way_m = float(np.linalg.norm(mean[3:]))
    line = (
        f"the vehicle moves by {100 * way_m:.0f} cm from one cloud to the next, and these are "
        f"taken as they are: if clouds of an instant are of other times, LiDARs are off; error "
        f"bars count {frames:.1f} of that; record while it stands, or with stamps and times of "
        "points"
    )
    poses = replace(poses, joint_covariance=poses.joint_covariance + each @ each.T)
    return poses, [line] if frames * way_m > _CLOCK_M else []


def _step_after(drive: Drive, number: int, planes: Planes, base: str) -> Array | None:
    """(6,) the twist of the base from a frame to the next; None if their planes do not fit."""
    with suppress(CalibrationError):
        cloud = drive.instant(number + 1, [base]).at_stamp(base, np.eye(4))
        both = [[thinned(of, _STEP_PLANES)] for of in (planes, find_planes(cloud))]
        T, _ = refine_poses(both, np.array([np.eye(4)] * 2), (base, base))
        near, on = count_matched(both, T)
        if on[0] > _STEP_SHARE * near[0]:
            return twist_between(T[1], np.eye(4))
    return None


def _join_by_motion(
    drive: Drive, instants: Sequence[Instant], guess: Mapping[str, Array | None], lost: str, *,
    base: str,
) -> tuple[LidarPoses, dict[str, str], str]:  # fmt: skip
    """The poses of LiDARs that share too little at one time, doubts of them, and a line.

    They are calibrated to what the base sees before and after.

    Raises:
        CalibrationError: if the motion is unknown, or they share too little with that, too.
    """
    maps, at, after = list[View](), list[Instant](), -1
    for instant in instants:
        if instant.frame > after and (found := drive.local_map(instant.frame, base)) is not None:
            after = found[1]
            maps, at = [*maps, found[0]], [*at, instant]
    if not maps:
        raise CalibrationError(f"{lost}; {_HOW_TO_JOIN}")
    turned = {name: T for name, given in guess.items() if given is None
              and (T := _turn_by_motion(drive, at, name, maps)) is not None}  # fmt: skip
    near = {**guess, **turned}
    views = {**_look(at, near, base), base: maps}
    start, doubts, lost = locate_lidars(views, near, base=base, turned=turned)
    if lost:
        raise CalibrationError(f"by motion, with what {base} sees {REACH_M:g} m before and after, "
                               f"too: {lost}")  # fmt: skip
    line = (f"{', '.join(guess)} and {base} share too little at one time: joined by motion, at "
            f"{len(maps)} places of what {base} sees {REACH_M:g} m before and after")  # fmt: skip
    poses = _solve(at, views, start, base=base, maps=maps)
    common = np.diag(np.tile(_COMMON_SIGMAS**2, len(guess)))
    return replace(poses, joint_covariance=poses.joint_covariance + common), doubts, line


def _turn_by_motion(
    drive: Drive, instants: Sequence[Instant], lidar: str, maps: Sequence[View]
) -> Array | None:
    """(4, 4) the rotation by which both LiDARs move alike, and have the ground below (hand-eye).

    None where the LiDAR's own motion is unknown.
    """
    own, moves = drive.of(lidar), [(i.frame, i.twist_per_s[3:]) for i in instants
                                   if i.twist_per_s is not None]  # fmt: skip
    both = np.array([(v, own.twist(frame)[3:]) for frame, v in moves]).reshape(-1, 2, 3)
    both = both[both[:, 1].any(axis=1)]
    if not len(both):
        return None
    ups = [
        find_upright("base", [view.points_m for view in maps])[2, :3],
        find_upright(lidar, [of.returns[lidar][0] for of in instants])[2, :3],
    ]
    speed_m_s = np.linalg.norm(both[:, 0], axis=1).max()
    pairs = np.concatenate([both, np.tile(speed_m_s * np.array(ups), (len(both), 1, 1))])
    return transform(Rotation.align_vectors(pairs[:, 0], pairs[:, 1])[0].as_matrix())


def _corrected_twice(instants: Sequence[Instant], T_base_lidar: Mapping[str, Array]) -> list[str]:
    """A line per LiDAR whose clouds were corrected for motion before."""
    moving, lines = [of for of in instants if of.twist_per_s is not None], list[str]()
    for name, T in T_base_lidar.items():
        turn = adjoints(invert(T)[None])[0]
        seen = spread_out(moving, LOOKED_AT)
        lines.append(corrected_twice(((i.returns[name], turn @ i.twist_per_s) for i in seen), name))
    return [*filter(None, lines)]


def _unequal_ranges(poses: LidarPoses) -> list[str]:
    """A line per LiDAR that measures longer or shorter ranges than the base."""
    return [
        f"{name} measures {100 * abs(longer_m):.1f} cm {'longer' if longer_m > 0 else 'shorter'} "
        f"ranges than {poses.base}: its pose allows for that; correct its "
        "ranges, or its points lie beside what other LiDARs see"
        for name, (longer_m, sigma_m) in poses.longer_m.items()
        if abs(longer_m) > max(_SURE * sigma_m, _LONGER_M)
    ]


def _find_vehicle(
    known: Vehicle | None, instants: Sequence[Instant], poses: LidarPoses, path: Path | None
) -> tuple[Vehicle | None, tuple[str, ...]]:
    """The vehicle's frame by the road and by the poses of a file, and what they cannot tell."""
    if known is None:
        return None, ()
    travel = Travel() if path is None else direction_of_travel(read_poses(path)[0])
    return find_vehicle(known, _road(instants, poses.T_base_lidar), travel)


def _road(instants: Sequence[Instant], T_base_lidar: Mapping[str, Array]) -> Road | None:
    """The road by the clouds of all LiDARs together; None if they show none."""
    joined = [
        np.concatenate([move_points(each.at_stamp(n, T), T) for n, T in T_base_lidar.items()])
        for each in instants
    ]
    try:
        return find_road(joined)
    except CalibrationError:  # the axes are named as unknown
        return None


def _usable(instants: Sequence[Instant]) -> tuple[list[Instant], list[str]]:
    """Those that stand or can be brought to one time, and lines on the others."""
    usable = [each for each in instants if each.is_usable]
    if not usable:
        raise DatasetError(
            f"in all {len(instants)} instants the vehicle moves, and points have no times: record "
            f"while it stands, or clouds with a field of times ({', '.join(TIMES)})"
        )
    lines, moving = [], sum(each.twist_per_s is not None for each in usable)
    if left := len(instants) - len(usable):
        lines.append(f"{left} of {len(instants)} instants are left out: the vehicle moves, and "
                     "points have no times")  # fmt: skip
    if moving:
        lines.append(f"in {moving} of {len(usable)} instants the vehicle moves: their clouds are "
                     "brought to one time by the points' times")  # fmt: skip
    return usable, lines


def _complete(frames: Sequence[Frame], rig: Rig) -> tuple[list[Frame], list[str]]:
    """Those with all clouds, and a line on the others."""
    complete = [frame for frame in frames if {*rig.other_lidars} <= frame.lidar_paths.keys()]
    if not complete:
        counts = {n: sum(n in frame.lidar_paths for frame in frames) for n in rig.other_lidars}
        found = ", ".join(f"{name} has {count}" for name, count in counts.items())
        raise DatasetError(
            f"no instant has a cloud of every LiDAR: of {len(frames)} of {rig.lidar}, {found}; "
            "clouds of one instant have the same name in each folder lidars/NAME"
        )
    left = len(frames) - len(complete)
    line = f"{left} of {len(frames)} instants lack a cloud and are left out"
    return complete, [line] if left else []


def judge_lidar(
    poses: LidarPoses, name: str, tolerance: tuple[float, float], *, doubt: str = "",
    twice: str = "",
) -> Verdict:  # fmt: skip
    """The verdict of one LiDAR for a tolerance [deg, cm].

    What counts data is in the error bar, and no sign of an error. The doubt is about the start:
    where another pose fits as well. Clouds may be corrected twice.
    """
    covariance, by_planes = poses.covariance[name], name in poses.matched
    checks = [
        *([threshold("lidar_matched").check(poses.matched[name])] if by_planes else []),
        threshold("lidar_instants").check(poses.places),
        *([Check(TWICE, "WARN", twice)] if twice else []),
        *(_loose(covariance, poses.base) or _wide(covariance, tolerance)),
    ]
    if poses.places > 1:
        apart = float(np.sqrt(max(poses.place_ratios)))
        checks.append(threshold("lidar_places").check(apart))
    beyond = min(probability_beyond(covariance, tolerance), _OPEN)
    if doubt:
        checks.append(Check("another placement", "WARN", doubt, kind="lidar_start"))
        beyond = max(beyond, _EITHER)
    signs = [check for check in checks if (check.kind or check.name) not in ABOUT_THE_DATA]
    return replace(judge(signs, beyond, tolerance, TABLES), checks=tuple(checks))


def _wide(covariance: Array, tolerance: tuple[float, float]) -> list[Check]:
    turn, shift = (np.linalg.eigvalsh(covariance[of, of])[-1] for of in (slice(3), slice(3, 6)))
    return [
        threshold("sigma_rotation", tolerance).check(float(np.degrees(np.sqrt(turn)))),
        threshold("sigma_translation", tolerance).check(100.0 * float(np.sqrt(shift))),
    ]


def _loose(covariance: Array, base: str) -> list[Check]:
    """The axes that planes hardly determine, if there are any."""
    ratios = np.sqrt(np.diag(covariance)) / GUESS_SIGMAS
    axes = [axis for axis, ratio in zip(_AXES, ratios, strict=True) if ratio > _LOOSE]
    if not axes:
        return []
    text = f"no plane that LiDARs share determines {', '.join(axes)} in {base}: the guess stays"
    return [Check("undetermined direction", "WARN", text, kind="lidar_loose")]
