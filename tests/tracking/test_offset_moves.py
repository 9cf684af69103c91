"""Moves of cameras whose time offset is followed: found, and the clock stays what it was."""

from __future__ import annotations

import numpy as np

from calibgraph.simulation.rigs import rig_of
from tests.tracking.late_drives import late, town, track
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
