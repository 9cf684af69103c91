"""Moves of cameras whose time offset is followed: found, and the clock stays what it was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibgraph.model.lens_estimate import LensEstimate
from calibgraph.simulation.rigs import rig_of
from calibgraph.tracking.assessment import _recent_checks
from calibgraph.tracking.state import State
from tests.tracking.drives import moved, moved_later, step_of
from tests.tracking.late_drives import OFFSET, late, town, track


@pytest.mark.slow
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


def test_after_a_move_the_offset_is_what_it_was() -> None:
    """The clock of a mount that has moved stays: the sigma rises by little more than the walk."""
    truth, tables = late(town(115, 2), np.full(115, 0.02), 2, moved_later(rig_of("kitti"), 110))
    updates = track(truth, tables)
    assert any(event.kind == "moved" for update in updates for event in update.events)
    before, after = (updates[frame].lens["image_2"][0] for frame in (105, -1))
    assert after.sigma < 1.5 * before.sigma < 2e-3
    assert abs(after.value - 0.02) < 3 * after.sigma


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
