"""Frames that come together: one gate each, one solve, and what one by one would give."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np

from calibgraph import (
    CorrespondenceError,
    Correspondences,
    IncrementalCalibrator,
    Rig,
    perturb,
)
from calibgraph.tracking.assessment import Update
from calibgraph.tracking.frames import StreamFrame
from tests.tracking.drives import drive, drive_at, pair_of

EPOCH = 10
STEP = np.array([0.01, 0.01, 0.0, 0.03, 0.0, 0.0])


def frames_of(tables: Sequence[Correspondences]) -> list[StreamFrame]:
    return [StreamFrame(int(table.frame[0]), table) for table in tables]


def guess_of(rig: Rig) -> Rig:
    return perturb(rig, rotation_deg=1, translation_m=0.1, seed=1)


def test_frames_that_come_together_give_the_numbers_of_one_by_one() -> None:
    """To the last bit, where both know the same frames; also after a move."""
    rig = pair_of()
    after = rig.moved_to({"left": gtsam.Pose3.Expmap(STEP).matrix() @ rig.T_camera_lidar["left"]})
    tables = drive_at(lambda frame: after if frame >= 33 else rig, 60)
    alone, states = IncrementalCalibrator(guess_of(rig)), dict[int, tuple[bytes, Update]]()
    for table in tables:
        update = alone.update(table)
        states[update.frame] = alone.to_bytes(), update
    tracker, groups = IncrementalCalibrator(guess_of(rig)), list[int]()
    for found in tracker.update_all(frames_of(tables)):
        assert isinstance(found, list)
        groups.append(len(found))
        state, expected = states[found[-1].frame]
        for camera in rig.cameras:
            np.testing.assert_array_equal(
                found[-1].T_camera_lidar[camera], expected.T_camera_lidar[camera]
            )
            np.testing.assert_array_equal(found[-1].covariance[camera], expected.covariance[camera])
        assert found[-1].events == expected.events
        if found[-1].frame % EPOCH == EPOCH - 1:
            assert tracker.to_bytes() == state
    assert max(groups) == EPOCH and len(groups) < len(tables) / 3


def one_by_one(
    tracker: IncrementalCalibrator, frames: Sequence[StreamFrame]
) -> tuple[list[Update], list[str]]:
    """The updates, and why frames are left out."""
    updates, refused = [], []
    for one in frames:
        try:
            updates.append(tracker.update(one.table, frame=one.frame))
        except CorrespondenceError as error:
            refused.append(str(error))
    return updates, refused


def test_frames_that_stand_out_are_taken_in_by_themselves() -> None:
    """Failed matches, an unknown camera, an old number, a repeated cloud, a frame without rows."""
    rig = pair_of()
    tables = drive(rig, 40)
    rng = np.random.default_rng(0)
    failed = tables[23].points_lidar_m + rng.normal(size=tables[23].points_lidar_m.shape)
    tables[23] = replace(tables[23], points_lidar_m=failed)
    tables[31] = replace(tables[31], points_lidar_m=tables[30].points_lidar_m)
    frames = frames_of(tables)
    frames[33] = StreamFrame(33, tables[33].select(slice(0, 0)))
    wrong = replace(tables[35], cameras=("left", "other"))
    frames[35:36] = [StreamFrame(35, wrong), StreamFrame(7, tables[7]), frames[35]]
    expected, refused = one_by_one(IncrementalCalibrator(guess_of(rig)), frames)
    results = [*IncrementalCalibrator(guess_of(rig)).update_all(frames)]
    found = [update for group in results if isinstance(group, list) for update in group]
    assert [str(one) for one in results if isinstance(one, CorrespondenceError)] == refused
    assert len(refused) == 2
    assert [(u.frame, u.left_out, {*u.used}) for u in found] == [
        (u.frame, u.left_out, {*u.used}) for u in expected
    ]
    assert found[23].left_out == ("left", "right") and not found[31].used and not found[33].used
