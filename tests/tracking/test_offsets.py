"""Time offsets that are followed while driving: not overrated, and kept where they are unseen."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from calibgraph import (
    CorrespondenceError,
    IncrementalCalibrator,
    concatenate,
    solve,
)
from calibgraph.graph.by_place import QuadraticByPlace
from calibgraph.graph.latent_poses import to_ordering
from calibgraph.graph.variables import cloud_at_key, matched_at_key, seen_lens_key
from calibgraph.model.geometry import twist_between
from calibgraph.simulation.rigs import rig_of
from calibgraph.tracking.offset_sums import with_offset
from calibgraph.tracking.sums import Sums
from tests.tracking.drives import moved_later
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


@pytest.mark.slow
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


@pytest.mark.slow
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


def test_frames_without_a_motion_are_refused_and_nothing_has_changed() -> None:
    truth, tables = late(town(6, 0), np.zeros(6))
    tracker = IncrementalCalibrator(truth, OFFSET)
    with pytest.raises(CorrespondenceError, match="the motion of the LiDAR must be known"):
        tracker.update(replace(tables[0], twist_per_s=None))
    assert tracker.frame is None


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
