"""Recalibration while driving: what a batch would say, what moved, and frames that harm nothing."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

from calibgraph import (
    Config,
    CorrespondenceError,
    Correspondences,
    Event,
    IncrementalCalibrator,
    Rig,
    Update,
    load_calibration,
    perturb,
    simulate_correspondences,
    solve,
)
from calibgraph.simulation.rigs import rig_of
from calibgraph.tracking import tracker as tracker_module
from calibgraph.tracking.assessment import json_lines
from calibgraph.tracking.cause import Steps, find_cause
from tests.conftest import KANNALA, make_camera, stereo_relative_pose
from tests.draws.lenses import with_known_lenses
from tests.tracking.drives import ERRORS, drive, drive_at, moved, pair_of, step_of

Array = np.ndarray


def tracked(
    guess: Rig, tables: list[Correspondences], **tracking: int
) -> tuple[IncrementalCalibrator, list[Update]]:
    tracker = IncrementalCalibrator(guess, Config().changed(tracking=tracking))
    return tracker, [tracker.update(table) for table in tables]


def difference(T: Array, other: Array) -> Array:
    """(6,) xi in T = exp(xi) other."""
    return np.asarray(gtsam.Pose3.Logmap(gtsam.Pose3(T @ np.linalg.inv(other))))


def events_of(updates: list[Update]) -> list[Event]:
    return [event for update in updates for event in update.events if event.kind != "started"]


@pytest.mark.slow
def test_a_static_rig_gives_what_a_batch_gives(mixed_rig: Rig) -> None:
    """The rest is the hard gate: a match at its edge is in for one and out for the other.

    At 100 frames of 200 matches, of which about 1.5 % lie within the 0.1 px by which gates differ,
    sqrt(300) matches of a pull of 1.3 against sqrt(20000) of 0.8: 0.2 sigma for the worst of 18
    components (2.5 of theirs); 0.1 root mean square.
    """
    known = with_known_lenses(mixed_rig)  # of a lens both see other directions
    guess = perturb(known, rotation_deg=1, translation_m=0.1, seed=1)
    table = simulate_correspondences(known, frames=100, matches=200, errors=ERRORS, seed=1)
    tables = [table.select(table.frame == frame) for frame in range(100)]
    _, updates = tracked(guess, tables, live_epochs=4)
    batch = solve(guess, table)
    last = updates[-1]
    apart = []
    for name in mixed_rig.cameras:
        expected, found = batch.covariance[name], last.covariance[name]
        sigmas = np.sqrt(np.diag(expected))
        apart.append(difference(last.T_camera_lidar[name], batch.T_camera_lidar[name]) / sigmas)
        np.testing.assert_allclose(np.diag(found), np.diag(expected), rtol=0.1)
        assert last.verdicts[name].status == "PASS"
    assert np.sqrt(np.mean(np.square(apart))) < 0.1
    assert not events_of(updates)


def test_clocks_and_swept_clouds_widen_the_bars_as_in_a_batch(tmp_path: Path) -> None:
    """5 ms at 10 m/s, or points 8 ms late at an unknown speed, are 5 or 8 cm ahead.

    That is the third axis of a camera that looks there.
    """
    rig = with_known_lenses(rig_of("kitti"))
    still = simulate_correspondences(rig, frames=30, matches=100, errors=ERRORS, seed=1)
    drives = replace(still, twist_per_s=np.tile([0, 0, 0, 10.0, 0, 0], (len(still), 1)))
    swept = replace(still, late_s=np.full(len(still), 0.008))
    ahead_cm, left_out = [], []
    for table in (still, drives, swept):
        tables = [table.select(table.frame == frame) for frame in range(30)]
        tracker, updates = tracked(rig, tables)
        batch, found = solve(rig, table).covariance, updates[-1].covariance
        ahead_cm.append([100 * np.sqrt(each["image_2"][5, 5]) for each in (found, batch)])
        kept = load_calibration(tracker.calibration().save(tmp_path))
        left_out.append(
            [what in kept.not_included for what in ("time offset", "motion during a scan")]
        )
        assert kept.motion == table.motion_column
    (alone, _), *wider = ahead_cm
    for (whole, in_batch), by_motion in zip(wider, (5.0, 8.0), strict=True):
        assert whole == pytest.approx(np.hypot(alone, by_motion), rel=0.1)
        assert whole == pytest.approx(in_batch, rel=0.1)
    assert left_out == [[True, True], [False, False], [True, False]]
    with pytest.raises(
        CorrespondenceError, match="has neither motion .* earlier frames have late_s"
    ):
        tracker.update(replace(still.select(still.frame == 29), frame=np.full(200, 30)))


def test_a_step_of_one_camera_is_found_within_3_frames_and_named(pair: Rig) -> None:
    after = moved(pair, "right", step_of(0.5, 3))
    tables = drive_at(lambda frame: after if frame >= 25 else pair, 50)
    tracker, updates = tracked(pair, tables)
    (event,) = events_of(updates)
    assert (event.kind, event.camera, event.frame) == ("moved", "right", 25)
    assert event.detected_frame <= 27
    for one in (tracker, IncrementalCalibrator.from_bytes(tracker.to_bytes())):
        assert one.calibration().summary.moves == (str(event),)
    assert abs(event.size.rotation_deg - 0.5) < 4 * event.size.rotation_sigma_deg
    for name, T in updates[-1].T_camera_lidar.items():
        xi = difference(T, after.T_camera_lidar[name])
        # 6 degrees of freedom, of which few are estimated from 25 frames: 50 is beyond 1e-7.
        assert xi @ np.linalg.solve(updates[-1].covariance[name], xi) < 50


def test_a_step_of_the_lidar_is_not_blamed_on_a_camera(mixed_rig: Rig) -> None:
    by = gtsam.Pose3.Expmap(step_of(0.5, 3)).matrix()
    after = mixed_rig.moved_to({name: T @ by for name, T in mixed_rig.T_camera_lidar.items()})
    tables = drive_at(lambda frame: after if frame >= 25 else mixed_rig, 40)
    _, updates = tracked(mixed_rig, tables)
    (event,) = events_of(updates)
    assert (event.kind, event.camera, event.frame) == ("moved", None, 25)
    assert "the LiDAR has moved since frame 25" in str(event)
    for name, T in updates[-1].T_camera_lidar.items():
        xi = difference(T, after.T_camera_lidar[name])
        assert np.degrees(np.linalg.norm(xi[:3])) < 0.1


def test_a_camera_that_was_blind_when_the_lidar_moved_is_carried_along(mixed_rig: Rig) -> None:
    by = gtsam.Pose3.Expmap(step_of(1.0, 5)).matrix()
    after = mixed_rig.moved_to({name: T @ by for name, T in mixed_rig.T_camera_lidar.items()})
    tables = drive_at(
        lambda frame: after if frame >= 42 else mixed_rig, 52, blind={"side": range(20, 200)}
    )
    _, updates = tracked(mixed_rig, tables)
    assert [(e.kind, e.camera) for e in events_of(updates)] == [("blind", "side"), ("moved", None)]
    xi = difference(updates[-1].T_camera_lidar["side"], after.T_camera_lidar["side"])
    assert np.degrees(np.linalg.norm(xi[:3])) < 0.2
    assert updates[-1].covariance["side"] is None


def test_a_large_knock_is_found_too(pair: Rig) -> None:
    after = moved(pair, "left", np.array([0.02, 0.12, -0.05, 0.2, 0.1, 0]))  # 7.5 deg, 22 cm
    tables = drive_at(lambda frame: after if frame >= 20 else pair, 30)
    _, updates = tracked(pair, tables)
    (event,) = events_of(updates)
    assert (event.camera, event.frame) == ("left", 20)
    xi = difference(updates[-1].T_camera_lidar["left"], after.T_camera_lidar["left"])
    assert np.degrees(np.linalg.norm(xi[:3])) < 0.1


def test_failed_matches_are_left_out_and_counted(pair: Rig) -> None:
    tables = drive_at(lambda frame: pair, 40, failed_share=0.3)
    tracker, updates = tracked(pair, tables)
    assert not events_of(updates)
    left_out = sum("left" in update.left_out for update in updates)
    assert 4 <= left_out <= 20  # 30 % of 40 is 12 +- 2.9
    assert tracker.calibration().counts["left"]["left_out"] == left_out
    xi = difference(updates[-1].T_camera_lidar["left"], pair.T_camera_lidar["left"])
    assert xi @ np.linalg.solve(updates[-1].covariance["left"], xi) < 50


def test_a_blind_camera_is_reported_once_and_again_when_it_is_back(pair: Rig) -> None:
    tables = drive_at(lambda frame: pair, 60, blind={"right": range(15, 40)})
    _, updates = tracked(pair, tables)
    blind, back = events_of(updates)
    assert (blind.kind, blind.camera) == ("blind", "right")
    assert (blind.frame, blind.detected_frame) == (15, 34)
    assert (back.kind, back.camera, back.frame) == ("back", "right", 40)
    assert any("no usable matches" in reason for reason in updates[38].verdicts["right"].reasons)
    assert updates[-1].verdicts["right"].status == "PASS"


@pytest.mark.slow
def test_a_drift_is_followed_with_an_honest_error_bar(pair: Rig) -> None:
    """0.001 deg a frame, ten times faster than in the long runs.

    The configured walk remembers 38 frames of this noise, so the estimate is 0.038 deg late; half
    of that again for noise.
    """
    rate = step_of(1e-3, 0)
    rig_at = lambda frame: moved(pair, "left", rate * max(0, frame - 100))  # noqa: E731
    tables = drive_at(rig_at, 500)
    _, updates = tracked(pair, tables)
    events = events_of(updates)
    assert events and all(event.camera == "left" for event in events)
    assert len(events) <= 2
    xi = difference(updates[-1].T_camera_lidar["left"], rig_at(499).T_camera_lidar["left"])
    covariance = updates[-1].covariance["left"]
    assert np.degrees(np.linalg.norm(xi[:3])) < 0.057
    assert abs(xi[1]) < 4 * np.sqrt(covariance[1, 1])


def test_a_move_ends_the_belief_in_the_rigs_relative_pose(pair: Rig) -> None:
    """1 mrad would hold the camera back: 0.5 deg is 9 of its sigmas."""
    tied = pair.model_copy(update={"relative_poses": (stereo_relative_pose(pair),)})
    after = moved(pair, "left", step_of(0.5, 0))
    tables = drive_at(lambda frame: after if frame >= 25 else pair, 45)
    _, updates = tracked(tied, tables)
    assert [event.camera for event in events_of(updates)] == ["left"]
    for name, T in updates[-1].T_camera_lidar.items():
        assert np.degrees(np.linalg.norm(difference(T, after.T_camera_lidar[name])[:3])) < 0.05


def test_a_camera_without_matches_is_held_by_a_relative_pose(pair: Rig) -> None:
    tied = pair.model_copy(update={"relative_poses": (stereo_relative_pose(pair),)})
    guess = perturb(tied, rotation_deg=1, translation_m=0.1, seed=2)
    tables = drive_at(lambda frame: pair, 30, blind={"right": range(100)})
    _, updates = tracked(guess, tables)
    xi = difference(updates[-1].T_camera_lidar["right"], pair.T_camera_lidar["right"])
    assert np.degrees(np.linalg.norm(xi[:3])) < 0.2
    assert updates[-1].verdicts["right"].cannot_tell  # it has no estimate of its own


def test_until_there_is_an_estimate_the_guess_is_given_and_nothing_can_be_told(pair: Rig) -> None:
    guess = perturb(pair, rotation_deg=2, translation_m=0.2, seed=4)
    _, updates = tracked(guess, drive_at(lambda frame: pair, 6))
    first = updates[0]
    np.testing.assert_allclose(first.T_camera_lidar["left"], guess.T_camera_lidar["left"])
    assert first.verdicts["left"].cannot_tell and first.covariance["left"] is None
    assert "1 of 5 frames" in first.verdicts["left"].reasons[0]
    assert [event.kind for event in updates[4].events] == ["started", "started"]


def test_an_update_that_fails_leaves_nothing_behind(
    pair: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the end of an epoch, when most has changed already."""
    tables = drive_at(lambda frame: pair, 22)
    tracker, _ = tracked(pair, tables[:19])
    before = tracker.to_bytes()

    judge, calls = tracker_module.make_updates, []

    def broken_once(*arguments: object, **options: object) -> object:
        calls.append(arguments)
        if len(calls) == 1:
            raise RuntimeError("broken")
        return judge(*arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(tracker_module, "make_updates", broken_once)
    with pytest.raises(CorrespondenceError, match=r"frame 19: .*broken.*left out"):
        tracker.update(tables[19])
    assert tracker.to_bytes() == before
    _, whole = tracked(pair, tables)
    for table, expected in zip(tables[19:], whole[19:], strict=True):
        found = tracker.update(table)
        np.testing.assert_array_equal(found.T_camera_lidar["left"], expected.T_camera_lidar["left"])


@pytest.mark.parametrize("noise_px", [0.0, 0.1])
def test_a_frozen_sensor_adds_nothing_and_is_blind(pair: Rig, noise_px: float) -> None:
    """The same cloud under new frame numbers: before, the error bar shrank to nothing."""
    tables, rng = drive_at(lambda _: pair, 12), np.random.default_rng(0)
    tracker, updates = tracked(pair, tables)
    before = updates[-1].covariance["left"]
    for number in range(12, 50):
        frame = np.full(len(tables[-1]), number, dtype=np.int64)
        noise = noise_px * rng.standard_normal(tables[-1].pixels_px.shape)
        pixels_px = tables[-1].pixels_px + noise
        update = tracker.update(replace(tables[-1], frame=frame, pixels_px=pixels_px))
    after = update.covariance["left"]
    assert (np.diag(after) > 0.8 * np.diag(before)).all()  # 38 new frames would leave a quarter
    (check,) = [c for c in update.verdicts["left"].checks if c.name in ("stuck", "blind frames")]
    assert check.text.startswith("the last 39 frames with matches have the same points")
    events = [event.kind for event in tracker.update(moved_on(tables[-1], 50)).events]
    assert "back" in events
    names = [check.name for check in tracker.calibration().camera_verdicts["left"].checks]
    assert "stuck" not in names


def test_a_stream_that_is_stuck_from_the_beginning_is_named(pair: Rig) -> None:
    """It is not told to keep driving."""
    (table,) = drive_at(lambda _: pair, 1)
    tables = [replace(table, frame=np.full(len(table), number)) for number in range(21)]
    tracker, _ = tracked(pair, tables[:20])
    assert "no estimate yet" in tracker.calibration().summary.reasons[0].text
    tracker.update(tables[20])
    result = tracker.calibration()
    assert result.verdict.status == "FAIL"
    assert result.summary.reasons[0].text.startswith(
        "the last 21 frames with matches have the same"
    )
    assert result.summary.actions[0].startswith("See why the same points come again")


def moved_on(table: Correspondences, number: int, times: int = 1) -> Correspondences:
    """Matches of points a tenth of a millimetre, so many times, further: another frame."""
    frame = np.full(len(table), number, dtype=np.int64)
    return replace(table, frame=frame, points_lidar_m=table.points_lidar_m + 1e-4 * times)


def steps_of(rig: Rig, steps: list[Array], sigma: float) -> Steps:
    T, n = np.array([*rig.T_camera_lidar.values()]), len(rig.cameras)
    return Steps(
        tuple(range(n)),
        np.ravel(steps),
        sigma**2 * np.eye(6 * n),
        np.full(n, 60.0),
        T,
    )


def test_the_cause_of_a_step_follows_from_the_steps_of_all_cameras(mixed_rig: Rig) -> None:
    T_lidar_cameras = [gtsam.Pose3(T).inverse() for T in mixed_rig.T_camera_lidar.values()]
    D = gtsam.Pose3.Expmap(step_of(0.3, 2))
    by_lidar = [np.asarray(p.localCoordinates(D.compose(p))) for p in T_lidar_cameras]
    cause = find_cause(steps_of(mixed_rig, by_lidar, 1e-4))
    np.testing.assert_allclose(cause.lidar[0], step_of(0.3, 2), atol=1e-9)
    still = np.zeros(6)
    assert find_cause(steps_of(mixed_rig, [still, by_lidar[1], still], 1e-4)).cameras == (1,)
    two = find_cause(steps_of(mixed_rig, [by_lidar[0], -by_lidar[1], still], 1e-4))
    assert two.lidar is None and two.cameras == (0, 1)
    assert find_cause(steps_of(mixed_rig, [still] * 3, 1e-4)).cameras == ()


def degenerate(number: int, good: Correspondences, rng: np.random.Generator) -> Correspondences:
    """A well-formed frame that determines nothing, or holds nonsense."""
    n = len(good)
    line = np.outer(np.linspace(5, 20, n), [1.0, 0.1, 0.05])
    kinds: tuple[Callable[[], Correspondences], ...] = (
        lambda: good.select(slice(0, 0)),
        lambda: good.select(np.zeros(n, np.intp)),
        lambda: good.select(rng.permutation(n)[: rng.integers(1, 14)]),
        lambda: replace(good, points_lidar_m=np.tile(good.points_lidar_m[:1], (n, 1))),
        lambda: replace(good, points_lidar_m=line),
        lambda: replace(good, points_lidar_m=-good.points_lidar_m),
        lambda: replace(good, points_lidar_m=line / line.max() * 999_999),
        lambda: replace(good, points_lidar_m=good.points_lidar_m * [1, 1, 0]),
        lambda: replace(good, points_lidar_m=np.zeros((n, 3))),
        lambda: replace(good, pixels_px=np.tile(good.pixels_px[:1], (n, 1))),
        lambda: replace(good, pixels_px=rng.uniform(-9e5, 9e5, (n, 2))),
        lambda: replace(good, pixels_px=good.pixels_px + rng.uniform(-300, 300, 2)),
        lambda: replace(good, confidence=np.full(n, 1e-30, np.float32)),
        lambda: replace(good, confidence=np.ones(n, np.float32)),
        lambda: replace(good, information_px=np.tile([1.0, 0.0, 0.0], (n, 1))),
        lambda: replace(good, information_px=np.tile([1e-6, 0.0, 1e6], (n, 1))),
        lambda: replace(good, information_px=np.tile([9e7, 0.0, 9e7], (n, 1))),
        lambda: replace(good, metadata={"systematic_rotation_rad": 1e-300}),
    )
    return kinds[number % len(kinds)]()


@pytest.mark.parametrize(
    ("kind", "share", "frames"),
    [
        ("one", 1.0, 34),
        pytest.param("fisheye", 0.4, 50, marks=pytest.mark.slow),
        pytest.param("fisheye", 1.0, 34, marks=pytest.mark.slow),
        ("mirror", 0.4, 34),
        pytest.param("tied", 0.4, 50, marks=pytest.mark.slow),
        ("tied", 1.0, 34),
    ],
)
def test_nonsense_neither_throws_nor_harms(kind: str, share: float, frames: int) -> None:
    """Every kind of nonsense. Warnings are errors here: no division by zero either."""
    tied = pair_of()
    rig = {
        "one": Rig(cameras={"only": make_camera()}),
        "fisheye": pair_of(model="fisheye", distortion=KANNALA),
        "mirror": pair_of(model="omnidirectional", distortion=(1.2, 0.02, -0.01, 1e-3, -1e-3)),
        "tied": tied.model_copy(update={"relative_poses": (stereo_relative_pose(tied),)}),
    }[kind]
    rng = np.random.default_rng(3)
    tracker = IncrementalCalibrator(perturb(rig, rotation_deg=1, translation_m=0.1, seed=3))
    for frame, good in enumerate(drive(rig, frames)):
        table = degenerate(frame // 2, good, rng) if rng.random() < share else good
        (line,) = json_lines([tracker.update(table, frame=frame)])
    again = IncrementalCalibrator.from_bytes(tracker.to_bytes())
    assert again.to_bytes() == tracker.to_bytes()
    for name, camera in json.loads(line)["cameras"].items():
        turn = np.array(camera["T_camera_lidar"]) @ np.linalg.inv(rig.T_camera_lidar[name])
        angle = np.degrees(np.arccos(np.clip((np.trace(turn[:3, :3]) - 1) / 2, -1, 1)))
        # 0.1 deg: nine times the sigma of thirty frames of 60 matches. Nonsense alone may agree.
        assert angle < 0.1 or share == 1.0


def test_the_joint_covariance_of_tied_cameras_has_no_negative_variance() -> None:
    pair = pair_of()
    tied = pair.model_copy(update={"relative_poses": (stereo_relative_pose(pair),)})
    tracker = IncrementalCalibrator(perturb(tied, rotation_deg=1, translation_m=0.1, seed=3))
    for table in drive(tied, 30, failed_share=0.2):
        tracker.update(table)
        joint = tracker.calibration().joint_covariance
        if joint is not None:  # of few frames it is singular, up to rounding
            values = np.linalg.eigvalsh(joint)
            assert values[0] > -1e-12 * values[-1]
