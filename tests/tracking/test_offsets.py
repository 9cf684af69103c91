"""Time offsets that are followed while driving: not overrated, and kept where they are unseen."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from calibgraph import (
    Config,
    CorrespondenceError,
    Correspondences,
    IncrementalCalibrator,
    Rig,
    concatenate,
    load_calibration,
    simulate_correspondences,
    solve,
)
from calibgraph.graph.by_place import QuadraticByPlace
from calibgraph.graph.latent_poses import to_ordering
from calibgraph.graph.variables import cloud_at_key, matched_at_key, seen_lens_key
from calibgraph.model.geometry import twist_between
from calibgraph.simulation.rigs import rig_of
from calibgraph.solver.camera_block import camera_blocks
from calibgraph.tracking.history import History
from calibgraph.tracking.live_frames import OutlierFrame
from calibgraph.tracking.offset_sums import with_offset, without_offset
from calibgraph.tracking.state import State
from calibgraph.tracking.sums import Sums
from calibgraph.tracking.update import json_line
from tests.conftest import make_pair
from tests.tracking.drives import content_of, moved_later
from tests.tracking.late_drives import (
    CONSTANT,
    OFFSET,
    RATE,
    STRAIGHT,
    late,
    moves,
    offset_errors,
    squared_errors,
    town,
    track,
)


def test_a_drifting_offset_is_followed_and_the_extrinsic_stays() -> None:
    """From 5 ms on; a ramp is behind by less than the sigma of a walk with its default."""
    offsets = 0.005 + RATE * np.arange(300)
    truth, tables = late(town(300, 0), offsets)
    updates = track(truth, tables)
    assert moves(updates) == []
    late_ones = [(update, offsets[update.frame]) for update in updates[100::20]]
    squares = [np.square(offset_errors(update, offset)) for update, offset in late_ones]
    assert np.mean(squares) < 2.0  # 1 of noise, and less than 1 of the lag
    assert np.max(squares) < 4.0**2
    assert np.mean([squared_errors(update, truth) for update, _ in late_ones]) < 1.25
    assert all(one.is_determined and one.sigma < 2e-3 for (one,) in updates[-1].lens.values())


def test_with_a_fixed_clock_the_same_drive_is_wrong() -> None:
    truth, tables = late(town(120, 0), np.full(120, 0.03))
    fixed, followed = (track(truth, tables, config)[-1] for config in (Config(), OFFSET))
    assert fixed.lens == {}
    assert max(squared_errors(followed, truth)) < 3.0  # of 6 numbers, 2 in 1000 are larger
    assert min(squared_errors(fixed, truth)) > 10.0


def test_straight_ahead_the_offset_is_not_determined() -> None:
    truth, tables = late(np.tile(STRAIGHT, (100, 1)), np.full(100, 0.02))
    updates = track(truth, tables)
    assert moves(updates) == []
    every = [one.sigma for update in updates[20:] for (one,) in update.lens.values()]
    assert min(every) > 0.99 * max(every)  # nothing of it is learned
    for (one,) in updates[-1].lens.values():
        assert not one.is_determined
        assert "not determined by these data" in one.describe()
        assert abs(one.value) < 1e-3 and one.correlation > 0.999
    assert max(squared_errors(updates[-1], truth)) < 3.0


def test_the_first_turn_after_a_way_straight_ahead_is_no_move() -> None:
    """All of 50 ms and 50 cm is found in it."""
    twists = np.vstack([np.tile(STRAIGHT, (60, 1)), town(140, 1)])
    truth, tables = late(twists, np.full(200, 0.05))
    updates = track(truth, tables)
    assert moves(updates) == []
    assert np.abs(offset_errors(updates[-1], 0.05)).max() < 4.0
    assert max(squared_errors(updates[-1], truth)) < 3.0
    for name, T in truth.T_camera_lidar.items():
        assert np.linalg.norm(twist_between(updates[-1].T_camera_lidar[name], T)[3:]) < 0.02


def test_a_move_is_found_while_the_offset_drifts() -> None:
    truth, tables = late(
        town(150, 2), 0.005 + RATE * np.arange(150), rig_at=moved_later(rig_of("kitti"), 120)
    )
    updates = track(truth, tables)
    (event,) = [e for update in updates for e in update.events if e.kind != "started"]
    assert (event.kind, event.camera, event.frame) == ("moved", "image_2", 120)


def test_a_constant_offset_is_that_of_a_batch() -> None:
    """Without a walk. As near as poses are with a known clock: 0.15 sigma."""
    truth, tables = late(town(120, 4), np.full(120, 0.02), seed=4)
    found, last = solve(truth, concatenate(tables), CONSTANT), track(truth, tables, CONSTANT)[-1]
    for name, T in found.T_camera_lidar.items():
        covariance, own = found.covariance[name], last.covariance[name]
        assert covariance is not None and own is not None
        twist = twist_between(last.T_camera_lidar[name], T)
        assert twist @ np.linalg.solve(covariance, twist) / 6 < 0.15**2
        assert np.diag(own) == pytest.approx(np.diag(covariance), rel=0.1)
        (batch,), (one,) = found.lens[name], last.lens[name]
        assert abs(one.value - batch.value) < 0.15 * batch.sigma
        assert one.sigma == pytest.approx(batch.sigma, rel=0.05)


def test_a_restart_goes_on_with_the_same_numbers() -> None:
    truth, tables = late(town(45, 0), 0.005 + RATE * np.arange(45))
    whole = IncrementalCalibrator(truth, OFFSET)
    for table in tables[:25]:
        whole.update(table)
    again = IncrementalCalibrator.from_bytes(whole.to_bytes())
    for table in tables[25:]:
        assert json_line(whole.update(table)) == json_line(again.update(table))


@pytest.mark.parametrize("settings", [{"estimate": "focal"}, {"estimate": "offset,readout"}])
def test_another_part_of_the_lens_is_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="offset alone"):
        IncrementalCalibrator(rig_of("kitti"), Config(**settings))


def test_frames_without_a_motion_are_refused_and_nothing_has_changed() -> None:
    truth, tables = late(town(6, 0), np.zeros(6))
    tracker = IncrementalCalibrator(truth, OFFSET)
    with pytest.raises(CorrespondenceError, match="the motion of the LiDAR must be known"):
        tracker.update(replace(tables[0], twist_per_s=None))
    assert tracker.frame is None


def test_the_command_writes_the_offset(tmp_path: Path, no_picture: None, piped: Any) -> None:
    truth, tables = late(town(12, 0), np.full(12, 0.02))
    truth.save(tmp_path / "rig.yaml")
    given = b"".join(line_of(table) for table in tables)
    code, out, err = piped(
        tmp_path / "rig.yaml", given, "--estimate", "offset", "--out", tmp_path / "out"
    )
    assert code in (0, 1), err  # twelve frames may be a FAIL
    last = json.loads(out.splitlines()[-1])["cameras"]["image_2"]
    saved = load_calibration(tmp_path / "out")
    (one,) = saved.lens["image_2"]
    assert last["time_offset_s"] == pytest.approx(one.value)
    assert last["time_offset_sigma_s"] == pytest.approx(one.sigma)
    assert saved.rig.cameras["image_2"].time_offset_s == pytest.approx(one.value)
    assert abs(one.value - 0.02) < 4 * one.sigma < 0.2


def line_of(table: Correspondences) -> bytes:
    assert table.twist_per_s is not None
    content = {**content_of(table), "twist_per_s": table.twist_per_s[0].tolist()}
    return json.dumps(content).encode() + b"\n"


def test_a_history_has_the_offset() -> None:
    truth, tables = late(town(12, 0), np.full(12, 0.02))
    history = History()
    updates = track(truth, tables)
    for update in updates:
        history.add(update)
    curve = history.curves()["image_3"]
    assert curve is not None and curve.xi.shape == (8, 7)
    values = [update.lens["image_3"][0].value for update in updates[4:]]
    assert curve.xi[:, 6] == pytest.approx(np.array(values) - values[-1], abs=1e-12)
    assert len(history.figure().axes) == 2 * 3


# Parts


def sums_of(rng: np.random.Generator, frames: int) -> Sums:
    A = rng.normal(size=(frames, 6, 12))
    hessian, gradient = A @ A.swapaxes(1, 2), rng.normal(size=(frames, 6))
    scatter = gradient[:, :, None] * gradient[:, None, :]
    ones = np.ones(frames)
    return Sums.of(
        hessian=hessian,
        gradient=gradient,
        reweighted=hessian,
        score=gradient,
        scatter=scatter,
        frames=ones,
        matches=ones,
    )


def test_an_offset_is_a_move_by_the_twist() -> None:
    """The quadratic at an offset is that of each frame at a pose that its twist has moved."""
    rng = np.random.default_rng(0)
    sums, twists, step, later = sums_of(rng, 4), rng.normal(size=(4, 6)), rng.normal(size=6), 0.3
    whole = with_offset(sums, twists).total()
    x = np.append(step, later)
    expected = 0.0
    for row in range(4):
        moved = step + later * twists[row]
        expected += moved @ sums.hessian[row] @ moved / 2 + sums.gradient[row] @ moved
    assert x @ whole.hessian @ x / 2 + whole.gradient @ x == pytest.approx(expected, rel=1e-12)


def test_without_the_offset_sums_have_the_marginal_of_a_known_one() -> None:
    rng = np.random.default_rng(1)
    whole = with_offset(sums_of(rng, 5), rng.normal(size=(5, 6))).total()
    found = without_offset(whole, np.array(4.0), np.array(3.0))
    known = whole.hessian + np.diag([0.0] * 6 + [12.0])
    assert np.linalg.inv(found.hessian) == pytest.approx(np.linalg.inv(known)[:6, :6], rel=1e-9)
    step = np.linalg.solve(known, -whole.gradient)
    assert np.linalg.solve(found.hessian, -found.gradient) == pytest.approx(step[:6], rel=1e-9)
    scatter = whole.scatter + np.diag([0.0] * 6 + [36.0])
    inverse = np.linalg.inv(known)
    expected = (inverse @ scatter @ inverse)[:6, :6]
    own = np.linalg.inv(found.hessian)
    assert own @ found.scatter @ own == pytest.approx(expected, rel=1e-9)


def test_the_quadratic_of_a_late_camera_is_its_factors() -> None:
    rng = np.random.default_rng(2)
    A = rng.normal(size=(7, 20))
    pose = gtsam.Pose3.Expmap(rng.normal(size=6))
    place, value = np.array([0]), rng.normal(size=1)
    late_one = QuadraticByPlace(place, [pose], (A @ A.T)[None], value[None], [seen_lens_key(0)])
    keys = cloud_at_key(0), matched_at_key(0, 0), seen_lens_key(0)
    values = gtsam.Values()
    values.insert(keys[0], gtsam.Pose3())
    values.insert(keys[1], pose)
    values.insert(keys[2], value)
    graph = gtsam.NonlinearFactorGraph()
    for factor in late_one.factors(0, keys[0], keys[1]):
        graph.add(factor)
    linear = graph.linearize(values)
    hessian = linear.hessian(to_ordering([keys[1], keys[2], keys[0]]))[0]
    assert hessian[:7, :7] == pytest.approx(A @ A.T, rel=1e-9)
    (sums,) = late_one.sums_in_time(pose.inverse().matrix()[None], value[None])
    assert sums.hessian == pytest.approx(A @ A.T, rel=1e-9)
    assert graph.error(values) == pytest.approx(float(sums.cost), abs=1e-12)


def test_motion_that_no_clock_needs_may_come_and_go() -> None:
    tracker = IncrementalCalibrator(make_pair())
    for frame, table in enumerate(_motion_for_some(make_pair())):
        assert tracker.update(table, frame=frame).frame == frame


def test_frames_without_motion_among_others_are_refused_where_a_clock_needs_it() -> None:
    rig = _late_pair()
    tracker = IncrementalCalibrator(rig)
    *known, unknown = _motion_for_some(make_pair())
    for frame, table in enumerate(known):
        tracker.update(table, frame=frame)
    with pytest.raises(CorrespondenceError, match=r"no motion of the LiDAR .* earlier frames have"):
        tracker.update(unknown, frame=len(known))
    again = replace(known[-1], frame=known[-1].frame + 2)
    assert tracker.update(again, frame=len(known) + 1).frame == len(known) + 1


def test_so_are_they_among_frames_from_which_a_tracker_has_not_started() -> None:
    tracker = IncrementalCalibrator(_late_pair())
    known = _motion_for_some(make_pair())[:-1]
    tables = [replace(one, twist_per_s=None) for one in known]
    for frame in range(2):
        tracker.update(tables[frame], frame=frame)
    tracker = IncrementalCalibrator.from_bytes(tracker.to_bytes())
    with pytest.raises(CorrespondenceError, match=r"a motion of the LiDAR .* earlier frames have"):
        tracker.update(known[2], frame=2)
    for frame in range(3, 8):
        update = tracker.update(tables[frame], frame=frame)
    assert all(verdict.status != "FAIL" for verdict in update.verdicts.values())


def test_frames_that_were_set_aside_tell_whether_the_motion_is_known() -> None:
    rig = _late_pair()
    known, unknown = _motion_for_some(make_pair())[-2:]
    state = State.initial(rig, Config())
    assert state.knows_motion is None
    for table, expected in (known, True), (unknown, False):
        frame = OutlierFrame(0, camera_blocks(rig, table, Config())["left"], gtsam.Pose3())
        one = replace(state.cameras[0], outlier_frames=(frame,))
        assert state.with_camera(0, one).knows_motion is expected


def _late_pair() -> Rig:
    rig = make_pair()
    late = {n: c.model_copy(update={"time_offset_s": 0.02}) for n, c in rig.cameras.items()}
    return rig.model_copy(update={"cameras": late})


def _motion_for_some(rig: Rig) -> list[Correspondences]:
    """A frame each; the last one's motion is not known."""
    table = simulate_correspondences(rig, frames=13, matches=80)
    frames = [table.select(table.frame == frame) for frame in range(13)]
    twist = np.array([0.0, 0.0, 0.1, 5.0, 0.0, 0.0])
    known = [replace(one, twist_per_s=np.tile(twist, (len(one), 1))) for one in frames[:-1]]
    return [*known, frames[-1]]
