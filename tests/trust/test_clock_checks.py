"""Images of another time, and motions in other units: seen by the motion of the LiDAR."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

from calibgraph import Config, Correspondences, Dataset, Frame, Rig, solve
from calibgraph.io.bags import MESSAGE_SUFFIX
from calibgraph.io.dataset import keep_frames
from calibgraph.io.frame import ScanMotion
from calibgraph.matching.protocol import FullMatcher, Matcher
from calibgraph.matching.run import MatchingRun
from calibgraph.model.geometry import invert
from calibgraph.model.verdict import Check
from calibgraph.progress import Stopwatch
from calibgraph.solver.joint import solve_joint
from calibgraph.trust.inputs import motion_doubts
from calibgraph.trust.lens_checks import (
    _with_known_motion,
    check_offset,
    fit_offset,
    image_offset_checks,
)
from calibgraph.trust.lens_parameter import RESIDUALS, LensParameter
from calibgraph.trust.thresholds import threshold
from factors import Clock
from tests.conftest import make_pair
from tests.draws.clocks import draw_twists, put_clock_error
from tests.solver.test_lens import FIVE_SIGMAS, simulated

STRAIGHT = np.array([0.0, 0.0, 0.0, 10.0, 0.0, 0.0])


def fit(offset_s: float, twists: np.ndarray | None = None) -> LensParameter:
    """The offset of a camera like KITTI's whose images are late: to first order in it."""
    rig, table = simulated(0, frames=30, matches=100)
    twists = draw_twists(30, np.random.default_rng(0)) if twists is None else twists
    (name, camera), *_ = rig.cameras.items()
    late = put_clock_error(table, rig, twists, Clock(offset_s)).of_camera(name)
    found = fit_offset(camera, late, 0.0)
    return found


@pytest.mark.parametrize("offset_s", [0.02, -0.02, 0.0])
def test_an_offset_is_recovered_within_its_sigma(offset_s: float) -> None:
    found = fit(offset_s)
    (seconds,), (sigma,) = found.units * found.values, found.units * found.sigmas
    assert abs(seconds - offset_s) < FIVE_SIGMAS * sigma
    assert sigma < 0.002
    assert (found.probability() > threshold("lens").warn) == (offset_s != 0.0)
    assert f"ms {'earlier' if seconds < 0 else 'later'}" in found.describe()


@pytest.mark.parametrize("twists", [np.zeros((30, 6)), np.tile(STRAIGHT, (30, 1))])
def test_at_rest_and_straight_ahead_nothing_is_known_of_it(twists: np.ndarray) -> None:
    """Less than the 40 ms of an offset that is wrong, so it raises no doubt, and that is told."""
    found = fit(0.05, twists)
    assert 0.002 * found.sigmas[0] > 0.04
    assert found.probability() < 1e-3
    check = check_offset(found, RESIDUALS)
    assert check.status == "PASS"
    assert "not determined by these data, and taken for right" in check.text
    assert ("10 ms would move the camera by 10 cm" in check.text) == twists.any()


def offset_check(table: Correspondences) -> list[Check]:
    rig, _ = simulated(0, frames=30, matches=100)
    verdicts = solve(rig, table).camera_verdicts.values()
    return [c for verdict in verdicts for c in verdict.checks if c.kind == "lens_time_offset"]


def test_a_table_with_motion_is_checked_and_names_the_cure() -> None:
    rig, table = simulated(0, frames=30, matches=100)
    assert offset_check(table) == []  # its motion is unknown
    late = put_clock_error(table, rig, draw_twists(30, np.random.default_rng(0)), Clock(0.04))
    checks = offset_check(late)
    assert len(checks) == len(rig.cameras)
    for check in checks:
        assert check.status == "FAIL"
        assert "correct the time stamps; or run with --estimate offset" in check.text


class Recorder:
    """A matcher that searches the offset, too, and records the offsets of the rigs it is given."""

    rounds, stage1, tracking_rounds, image_checks_can_fail = 1, "rig", (0,), True

    def __init__(self, table: Correspondences) -> None:
        self.table, self.offsets_s = table, list[float | None]()

    def with_estimate(self, parts: Sequence[str]) -> Recorder:  # noqa: ARG002
        other = copy(self)
        other.offsets_s = self.offsets_s
        return other

    def match(self, dataset, rig, *, round_index, progress):  # noqa: ANN001, ANN201, ARG002
        self.offsets_s += [camera.time_offset_s for camera in rig.cameras.values()]
        numbers = [frame.index for frame in dataset.frames]
        return self.table.select(np.isin(self.table.frame, numbers))

    def release(self) -> None:
        pass


def run_of(
    matcher: Matcher, rig: Rig, frames: Sequence[Frame], found: Correspondences
) -> MatchingRun:
    data = Dataset(rig=rig, frames=tuple(frames), folders=())
    solution = solve_joint(rig, found, Config())
    return MatchingRun(
        data, FullMatcher(matcher), rig, found, solution, rounds=(), watch=Stopwatch()
    )


def moving_frames(twists: np.ndarray) -> list[Frame]:
    motions = [ScanMotion(tuple(twist.tolist()), 0.0) for twist in twists]
    return [
        Frame(n, str(n), Path(f"{n}.pcd"), {}, find_motion=lambda found=found: found)
        for n, found in enumerate(motions)
    ]


def late_by(offset_s: float) -> tuple[Rig, Correspondences, np.ndarray]:
    rig, table = simulated(0, frames=30, matches=100)
    twists = draw_twists(30, np.random.default_rng(0))
    return rig, put_clock_error(table, rig, twists, Clock(offset_s)), twists


def test_the_times_of_a_rig_stand_where_the_motion_of_a_bag_is_known() -> None:
    rig, table, twists = late_by(0.04)
    cameras = {n: c.model_copy(update={"time_offset_s": 0.04}) for n, c in rig.cameras.items()}
    stated = rig.model_copy(update={"cameras": cameras})
    matcher = Recorder(replace(table, twist_per_s=None))
    checks = [*image_offset_checks(run_of(matcher, stated, moving_frames(twists), table))]
    assert matcher.offsets_s == [0.04] * len(rig.cameras)
    assert {check.status for _, check in checks} == {"PASS"}


def register_clouds(poses: Sequence[np.ndarray], monkeypatch: pytest.MonkeyPatch) -> None:
    """Clouds of frames at these poses fit exactly."""

    def register(target: int, source: int, _: Path) -> np.ndarray:
        return np.asarray(invert(poses[target]) @ poses[source])

    monkeypatch.setattr("calibgraph.io.frame.register", register)
    monkeypatch.setattr("calibgraph.io.frame.prepare_scan", lambda points: int(points[0, 0]))
    monkeypatch.setattr(Frame, "load_cloud", lambda frame: np.full((1, 4), frame.index))


@pytest.mark.parametrize(
    ("stems", "suffix", "apart_s", "is_told"),
    [
        ([f"{3 * n:06d}" for n in range(30)], ".bin", 0.3, True),  # KITTI, every third
        ([f"{n:06d}" for n in range(30)], ".bin", 0.1, True),
        ([f"scan_{n:02d}" for n in range(30)], ".pcd", 0.1, True),
        ([str(100 * n) for n in range(30)], ".pcd", 0.1, True),  # which count something else
        ([str(1_533_151_603_547_590 + 50_000 * n) for n in range(30)], ".bin", 0.05, False),
        ([str(7_000_000_000 + 200_000_000 * n) for n in range(30)], ".message", 0.2, False),
    ],
)
def test_clouds_are_as_far_apart_as_their_stamps_or_numbers_say(
    stems: list[str], suffix: str, *, apart_s: float, is_told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig, table, _ = late_by(0.0)
    suffix = MESSAGE_SUFFIX if suffix == ".message" else suffix
    ahead = gtsam.Pose3(gtsam.Rot3(), np.array([2.0, 0.0, 0.0])).matrix()
    register_clouds([np.linalg.matrix_power(ahead, n) for n in range(len(stems))], monkeypatch)
    frames = tuple(Frame(n, s, Path("drive") / f"{s}{suffix}", {}) for n, s in enumerate(stems))
    kept = keep_frames(Dataset(rig=rig, frames=frames, folders=()))
    moved, by_scans = _with_known_motion(kept)
    assert moved is not None and by_scans
    for frame in moved.frames:
        np.testing.assert_allclose(frame.twist_per_s, [0, 0, 0, 2.0 / apart_s, 0, 0], atol=1e-9)
    matcher = Recorder(replace(table, twist_per_s=None))
    checks = image_offset_checks(run_of(matcher, rig, kept.frames, table))
    told = ["successive clouds are taken to be 0.1 s apart" in check.text for _, check in checks]
    assert told == [is_told] * len(rig.cameras)


FRAMES = 30
STAMPED = [str(1_533_151_603_547_590 + 100_000 * n) for n in range(FRAMES)]  # microseconds
NUMBERED = [f"{n:06d}" for n in range(FRAMES)]
KMH = np.array([1, 1, 1, 3.6, 3.6, 3.6])


@pytest.fixture
def drive(monkeypatch: pytest.MonkeyPatch) -> np.ndarray:
    """(n, 6) twists of a car in town, of which neighbouring clouds 0.1 s apart show the steps."""
    t = 0.1 * np.arange(FRAMES)
    yaw, ahead, none = 0.3 * np.sin(2 * t), 8.0 + np.sin(t), np.zeros(FRAMES)
    twists = np.column_stack([0.02 * np.sin(5 * t), 0.02 * np.cos(7 * t), yaw, ahead, none, none])
    poses = [np.eye(4)]
    for twist in twists:
        poses.append(poses[-1] @ gtsam.Pose3.Expmap(0.1 * twist).matrix())
    register_clouds(poses, monkeypatch)
    return (twists[:-1] + twists[1:]) / 2


def doubts(told: np.ndarray, stems: list[str]) -> list[str]:
    motions = [ScanMotion(tuple(twist.tolist()), 0.0) for twist in np.vstack([told[:1], told])]
    frames = [
        Frame(n, stem, Path("drive") / f"{stem}.bin", {}, find_motion=lambda n=n: motions[n])
        for n, stem in enumerate(stems)
    ]
    return motion_doubts(Dataset(rig=make_pair(), frames=tuple(frames), folders=()))


@pytest.mark.parametrize("stems", [STAMPED, NUMBERED])
def test_a_right_motion_raises_no_doubt_and_km_per_h_do(
    stems: list[str], drive: np.ndarray
) -> None:
    assert doubts(drive, stems) == []
    (text,) = doubts(drive * KMH, stems)
    assert text.endswith("is it in km/h?")
    (text,) = doubts(drive * np.repeat([1.0, 0.5], 3), stems)
    assert text.endswith("check its unit")


@pytest.mark.parametrize("order", [[0, 2, 1], [2, 1, 0], [1, 2, 0]])
def test_turns_about_other_axes_are_named(order: list[int], drive: np.ndarray) -> None:
    told = drive.copy()
    told[:, order] = drive[:, :3]
    (text,) = doubts(told, STAMPED)
    names = ", ".join(("wx", "wy", "wz")[axis] for axis in order)
    assert f"{names} in the place of wx, wy, wz would fit" in text


def test_where_clouds_are_further_apart_than_usual_the_speed_per_turn_counts(
    drive: np.ndarray,
) -> None:
    """Every frame is 0.36 s after the one before, which no name says."""
    assert doubts(drive / 3.6, NUMBERED) == []
