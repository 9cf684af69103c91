"""Moves of cameras whose time offset is followed: found, and the clock stays what it was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibgraph import Config
from calibgraph.model.geometry import to_T_camera_lidar, to_T_lidar_camera
from calibgraph.model.lens_estimate import LensEstimate
from calibgraph.simulation.rigs import rig_of
from calibgraph.solver.camera_block import camera_blocks
from calibgraph.tracking.assessment import _recent_checks
from calibgraph.tracking.live_frames import OutlierFrame
from calibgraph.tracking.offset_sums import with_offset
from calibgraph.tracking.offset_terms import score_after
from calibgraph.tracking.state import State
from calibgraph.tracking.sums import Sums
from tests.tracking.drives import moved_later
from tests.tracking.late_drives import OFFSET, STRAIGHT, late, town, track
from tests.tracking.steps import moved, step_of


def test_a_small_move_is_found_although_the_offset_is_estimated() -> None:
    """Of two sigmas of a frame: no frame disagrees, and the later ones scatter as the earlier."""
    rig = rig_of("kitti")
    after = moved(rig, "image_2", step_of(0.15, 0.0))
    truth, tables = late(
        town(150, 5), np.full(150, 0.02), 5, lambda k: after if k >= 100 else rig, matches=60
    )
    updates = track(truth, tables)
    (event,) = [e for update in updates for e in update.events if e.kind != "started"]
    assert (event.kind, event.camera) == ("moved", "image_2")
    assert abs(event.frame - 100) <= 5


def test_an_unknown_offset_counts_as_far_as_motions_differ() -> None:
    """Frames of one motion tell a move from an earlier pose as with a known offset, whatever it is.

    Of others, an offset of 50 ms displaces the score by as much as their motions differ.
    """
    state = State.initial(rig_of("kitti"), OFFSET)
    A = 1e4 * np.random.default_rng(0).normal(size=(6, 20))
    hessian, frames = A @ A.T, np.array(50.0)
    poses = Sums.zeros().change(hessian=hessian, reweighted=hessian, scatter=hessian, frames=frames)
    before, turn = with_offset(poses, STRAIGHT), np.array([0, 0, 0.2, 0, 0, 0])
    walk = state.config.tracking.walk_time_offset_s**2 * frames
    for motion, variance in ((STRAIGHT, walk), (STRAIGHT + turn, walk + 0.05**2)):
        moved = np.outer(turn, turn) * 0.05**2 if variance > walk else np.zeros((6, 6))
        along = np.outer(motion, motion) * walk
        expected = 2 * hessian + hessian @ (moved + along) @ hessian
        score, covariance = score_after(state, 0, before, with_offset(poses, motion))
        assert np.array_equal(score, np.zeros(6))
        assert np.abs(covariance - expected).max() < 0.01 * expected.max()  # by weak priors


def test_after_a_move_the_offset_is_what_it_was() -> None:
    """The clock of a mount that has moved stays: the sigma rises by little more than the walk."""
    truth, tables = late(town(115, 2), np.full(115, 0.02), 2, moved_later(rig_of("kitti"), 110))
    updates = track(truth, tables)
    assert any(event.kind == "moved" for update in updates for event in update.events)
    before, after = (updates[frame].lens["image_2"][0] for frame in (105, -1))
    assert after.sigma < 1.5 * before.sigma < 2e-3
    assert abs(after.value - 0.02) < 3 * after.sigma


def test_what_was_not_known_before_a_move_is_not_known_after_it() -> None:
    """Straight ahead, 50 ms of the prior are left."""
    truth, tables = late(
        np.tile(STRAIGHT, (45, 1)), np.full(45, 0.02), rig_at=moved_later(rig_of("kitti"), 40)
    )
    updates = track(truth, tables)
    assert any(event.kind == "moved" for update in updates for event in update.events)
    before, after = (updates[frame].lens["image_2"][0] for frame in (35, -1))
    assert not after.is_determined
    assert 0.95 * before.sigma < after.sigma < 0.051


def test_frames_of_a_camera_that_has_moved_do_not_show_its_offset() -> None:
    """Straight ahead at 10 m/s it leaves 36 cm, before the move and after it."""
    rig, ahead = rig_of("kitti"), np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.4])
    after = moved(rig, "image_2", ahead)
    truth, tables = late(
        np.tile(STRAIGHT, (45, 1)), np.full(45, 0.02), rig_at=lambda k: after if k >= 40 else rig
    )
    events = [event for update in track(truth, tables) for event in update.events]
    (size,) = [event.size for event in events if event.kind == "moved"]
    assert size is not None
    assert size.translation_sigma_cm == pytest.approx(2**0.5 * 36, rel=0.1)


def test_a_drift_names_what_may_be_the_clock() -> None:
    """A mount that turns, and a clock that drifts, are told apart as well as they correlate."""
    state = State.initial(rig_of("kitti"), OFFSET)
    one = replace(state.cameras[0], summary=replace(state.cameras[0].summary, walk=3))
    offset = LensEstimate("offset", "s", 0.02, 0.001, 0.0, 0.05, "yaw", 0.874)
    (check,) = _recent_checks(state, one, (offset,))
    assert check.status == "WARN"
    assert check.text.endswith(
        "part of it may be the other, by their correlation: offset with yaw 0.87"
    )
    (check,) = _recent_checks(state, one, (replace(offset, correlation=0.0),))
    assert check.text == "drifts: the estimate follows, over fewer frames"


def test_a_frame_that_is_set_aside_keeps_its_errors_at_another_offset() -> None:
    rig, (table,) = late(town(1, 0), np.zeros(1))
    pose = to_T_lidar_camera(rig.T_camera_lidar["image_2"])
    frame = OutlierFrame(0, camera_blocks(rig, table, Config())["image_2"], pose)
    later = frame.delayed(0.1)
    before, after = (
        one.raw.errors_px(to_T_camera_lidar(one.T_lidar_camera))[0] for one in (frame, later)
    )
    assert np.allclose(after, before, atol=1e-6)
    assert np.linalg.norm(later.T_lidar_camera.translation() - pose.translation()) > 0.3
