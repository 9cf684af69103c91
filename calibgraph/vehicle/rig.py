"""The LiDARs of a rig from the frames of a dataset, with a verdict of each."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError, DatasetError
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.io.frame import Frame
from calibgraph.model.config import Config
from calibgraph.model.rig import Lidar, Rig, Vehicle
from calibgraph.model.verdict import ABOUT_THE_DATA, Check, Verdict
from calibgraph.progress import Progress
from calibgraph.trust.probability import TABLES, judge, probability_beyond
from calibgraph.trust.thresholds import threshold
from calibgraph.vehicle.frame import Road, find_road, find_vehicle
from calibgraph.vehicle.lidars import GUESS_SIGMAS, LidarPoses, calibrate_lidars
from calibgraph.vehicle.start import locate_lidars
from calibgraph.vehicle.travel import POSE_FILES, Travel, direction_of_travel, read_poses

MOST_INSTANTS = 20
"""Of a recording, spread over it: more hardly narrow what places differ by."""

_LOOSE = 0.3  # sigma of an axis over that of the guess: planes hardly determine it
_OPEN = 0.98  # probability of an error by a bar alone: what is open is not known to be wrong
_EITHER = 0.5  # the same, where another pose fits as well
_AXES = ("roll x", "pitch y", "yaw z", "x", "y", "z")
_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class LidarResult:
    """What is found of a rig's LiDARs.

    Attributes:
        lidars: the rig's, with T_base_lidar and its covariance.
        vehicle: the rig's, with T_vehicle_lidar and its sigmas; None if the rig has none.
        poses: of them.
        verdicts: per LiDAR but the base.
        warnings: about the instants and the start, a line each.
    """

    lidars: Mapping[str, Lidar]
    vehicle: Vehicle | None
    poses: LidarPoses
    verdicts: Mapping[str, Verdict]
    warnings: tuple[str, ...]


def calibrate_rig_lidars(
    dataset: Dataset, rig: Rig, config: Config, *, progress: Progress
) -> LidarResult:
    """The poses of a rig's LiDARs in its base, from clouds of instants.

    The vehicle stands at each instant, or the clouds of an instant have been brought to one time.

    Args:
        dataset: its frames have the clouds of all LiDARs; those that lack one are left out.
        rig: with the guess of each LiDAR, or none.
        config: the tolerance of the verdict.
        progress: called with the stage, its steps done, and their number.

    Raises:
        DatasetError: if no instant has all clouds.
        CalibrationError: if a LiDAR shares too little with others.
    """
    frames = _complete(dataset.frames, rig)
    warnings = []
    if left := len(dataset.frames) - len(frames):
        warnings.append(f"{left} of {len(dataset.frames)} instants lack a cloud and are left out")
    chosen = spread_out(frames, MOST_INSTANTS)
    clouds = dict[str, list[Array]]({name: [] for name in (rig.lidar, *rig.other_lidars)})
    for number, frame in enumerate(chosen):
        progress("reading clouds of LiDARs", number, len(chosen))
        clouds[rig.lidar].append(frame.load_cloud()[:, :3].astype(np.float64))
        for name in rig.other_lidars:
            clouds[name].append(frame.load_lidar(name)[:, :3].astype(np.float64))
    guess = {name: rig.T_base_lidar.get(name) for name in rig.other_lidars}
    known = {name: T for name, T in guess.items() if T is not None}
    progress("locating LiDARs", 0, 1)
    try:
        start, doubts = locate_lidars(clouds, guess, base=rig.lidar)
    except CalibrationError as error:
        if len(known) < len(guess):
            raise
        warnings.append(f"{error}; begun from the guess")
        start, doubts = known, {}
    progress("calibrating LiDARs", 0, 1)
    poses = calibrate_lidars(clouds, start, base=rig.lidar)
    lidars = {rig.lidar: Lidar()} | {
        name: Lidar(T_base_lidar=poses.T_base_lidar[name], covariance=poses.covariance[name])
        for name in rig.other_lidars
    }
    vehicle = None
    if rig.vehicle is not None:
        progress("finding the vehicle's frame", 0, 1)
        vehicle, unknown = find_vehicle(rig.vehicle, _road(clouds, poses), _travel(dataset))
        warnings += unknown
    for line in warnings:
        _log.warning(line)
    return LidarResult(
        {name: lidars[name] for name in rig.lidars or {}},
        vehicle,
        poses,
        {
            name: judge_lidar(poses, name, config.tolerance, doubt=doubts.get(name, ""))
            for name in rig.other_lidars
        },
        tuple(warnings),
    )


def _road(clouds: Mapping[str, Sequence[Array]], poses: LidarPoses) -> Road | None:
    """The road by the clouds of all LiDARs together; None if they show none."""
    joined = [
        np.concatenate([
            cloud[:, :3] @ T[:3, :3].T + T[:3, 3]
            for cloud, T in zip(at, poses.T_base_lidar.values(), strict=True)
        ])
        for at in zip(*(clouds[name] for name in poses.T_base_lidar), strict=True)
    ]  # fmt: skip
    try:
        return find_road(joined)
    except CalibrationError:  # the axes are named as unknown
        return None


def _travel(dataset: Dataset) -> Travel | None:
    """The direction of travel by the poses beside the data; None without any."""
    paths = (folder / name for folder in dataset.folders for name in POSE_FILES)
    path = next((path for path in paths if path.is_file()), None)
    return None if path is None else direction_of_travel(read_poses(path))


def _complete(frames: Sequence[Frame], rig: Rig) -> list[Frame]:
    complete = [frame for frame in frames if {*rig.other_lidars} <= frame.lidar_paths.keys()]
    if not complete:
        counts = {n: sum(n in frame.lidar_paths for frame in frames) for n in rig.other_lidars}
        found = ", ".join(f"{name} has {count}" for name, count in counts.items())
        raise DatasetError(
            f"no instant has a cloud of every LiDAR: of {len(frames)} of {rig.lidar}, {found}; "
            "clouds of one instant have the same name in each folder lidars/NAME"
        )
    return complete


def judge_lidar(
    poses: LidarPoses, name: str, tolerance: tuple[float, float], *, doubt: str = ""
) -> Verdict:
    """The verdict of one LiDAR for a tolerance [deg, cm].

    What counts data is in the error bar, and no sign of an error. The doubt is about the start:
    where another pose fits as well.
    """
    covariance = poses.covariance[name]
    checks = [
        threshold("lidar_matched").check(poses.matched[name]),
        threshold("lidar_instants").check(poses.places),
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
