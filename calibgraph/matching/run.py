"""The result of matching and solving in rounds: the input of the checks on images."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from calibgraph.arrays import Array
from calibgraph.errors import MotionError
from calibgraph.io.dataset import Dataset
from calibgraph.matching.protocol import FullMatcher
from calibgraph.model.clock import OF_IMAGES, require_motion
from calibgraph.model.config import LensPart
from calibgraph.model.correspondences import TWIST_RULE, Correspondences, beyond_vehicles
from calibgraph.model.geometry import angle_deg, relative_transform
from calibgraph.model.rig import Rig
from calibgraph.parallel import core_pool
from calibgraph.progress import Progress, Stopwatch, no_progress
from calibgraph.solver.solution import Solution
from factors.columns import CLOCK

RoundSummary = Mapping[str, Mapping[str, float]]
"""Per camera: number of ``matches``, and the motion of the estimate in the round, ``moved_deg`` and
``moved_cm``."""


@dataclass(frozen=True, eq=False)
class MatchingRun:
    """The result of all rounds.

    Attributes:
        dataset: images and clouds.
        matcher: of the rounds.
        guess: the initial guess.
        correspondences: of the last round; for cameras taken from the displaced start, of its last
            round.
        solution: of the joint solve of these correspondences.
        rounds: summary of each round.
        watch: seconds per stage.
        missed_rounds: number of rounds that the time limit cut off.
        out_of_time: whether the time limit has passed.
        warnings: about the dataset and its guess; about a lens or clock that did not settle.
        rematch: per camera that was matched again from a start displaced from the end of the
            rounds, (4, 4) T_camera_lidar of that end, and of the end from there.
        rematch_failure: why there is no such end; then both are that of the rounds.
        is_late: whether the time limit has passed by now.
        went_on: per camera whose rounds went on from where its images agree better, how far that
            was [deg, cm].
        excluded: cameras that the user excluded.
        copies: names of the frames that were left out as copies, each with that of its original.
        hashes: SHA-256 of the files that it read, by path.
        progress: called as the work goes on.
    """

    dataset: Dataset
    matcher: FullMatcher
    guess: Rig
    correspondences: Correspondences
    solution: Solution
    rounds: tuple[RoundSummary, ...]
    watch: Stopwatch
    missed_rounds: int = 0
    out_of_time: bool = False
    warnings: tuple[str, ...] = ()
    rematch: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)
    rematch_failure: str = ""
    is_late: Callable[[], bool] = lambda: False
    went_on: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    excluded: tuple[str, ...] = ()
    copies: tuple[tuple[str, str], ...] = ()
    hashes: Mapping[str, str] = field(default_factory=dict)
    progress: Progress = no_progress


def require_known_motion(data: Dataset, matcher: FullMatcher, parts: Sequence[LensPart]) -> None:
    """Find the motion of all frames, if parts of the clock are to be estimated by it.

    Raises:
        CorrespondenceError: if it is not known of all, nor to the matcher.
        DatasetError: if neighbouring clouds do not fit.
    """
    if matcher.knows_motion or {*CLOCK}.isdisjoint(parts):
        return
    with core_pool() as cores:  # registrations, which frames keep
        twists = [*cores.map(lambda frame: frame.twist_per_s, data.frames)]
    known = all(twist is not None for twist in twists)
    require_motion(parts, is_known=known, how=OF_IMAGES)


def with_motion(table: Correspondences, data: Dataset) -> Correspondences:
    """The table with the motion of the LiDAR in each frame, where it is known of all of them.

    Raises:
        MotionError: if no vehicle has it.
    """
    twists = {frame.index: frame.twist_per_s for frame in data.frames}
    for frame in data.frames:
        twist = twists[frame.index]
        if twist is not None and beyond_vehicles(twist[None])[0]:
            raise MotionError(
                f"frame {frame.name}: the motion of the LiDAR must {TWIST_RULE}, found "
                f"{np.round(twist, 3).tolist()}; correct the odometry, or the time between clouds"
            )
    known = {number: twist for number, twist in twists.items() if twist is not None}
    if table.twist_per_s is not None or not {*table.frame.tolist()} <= known.keys():
        return table
    of_rows = np.array([known[number] for number in table.frame.tolist()]).reshape(-1, 6)
    return replace(table, twist_per_s=of_rows)


def with_delays(table: Correspondences, data: Dataset) -> Correspondences:
    """The table with how long after its pixel each point was taken, where clouds are as swept.

    It is zero in frames during which the vehicle stands. Images of unknown times count as taken in
    the middle of the sweep.
    """
    first = data.frames[0]
    if not len(table) or first.find_motion or first.load_sweep() is None:
        return table
    late_s, stands = np.zeros(len(table)), {n for stop in table.places.stationary for n in stop}
    for frame in data.frames:
        rows = np.flatnonzero(table.frame == frame.index)
        sweep = None if frame.index in stands or not len(rows) else frame.load_sweep()
        if sweep is None:
            continue
        points, times_s = sweep
        taken_s = [frame.image_after_s(name) for name in table.cameras]
        middle_s = (times_s.min() + times_s.max()) / 2
        each_s = np.array([middle_s if of is None else of for of in taken_s])
        _, nearest = cKDTree(points).query(table.points_lidar_m[rows])
        late_s[rows] = times_s[nearest] - each_s[table.camera_index[rows]]
    return replace(table, late_s=late_s)


def summarize_round(table: Correspondences, before: Rig, after: Rig) -> RoundSummary:
    """How many matches a round found, and how far it moved each camera."""
    counts = table.counts()
    cameras = {}
    for name, old in before.T_camera_lidar.items():
        delta = relative_transform(after.T_camera_lidar[name], old)
        cameras[name] = {
            "matches": counts.get(name, 0),
            "moved_deg": angle_deg(delta[:3, :3]),
            "moved_cm": 100.0 * float(np.linalg.norm(delta[:3, 3])),
        }
    return cameras


def round_in_words(summary: RoundSummary) -> str:
    """The summary of a round as one line."""
    return "; ".join(
        f"{name} {each['matches']:.0f} matches, moved {each['moved_deg']:.2f} deg, "
        f"{each['moved_cm']:.1f} cm"
        for name, each in summary.items()
    )
