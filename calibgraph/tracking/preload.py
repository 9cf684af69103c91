"""Loading all that updates use before the first frame comes."""

from __future__ import annotations

from calibgraph.simulation.correspondences import simulate_correspondences
from calibgraph.simulation.rigs import rig_of
from calibgraph.tracking.tracker import IncrementalCalibrator

_FRAMES, _MATCHES = 24, 250  # enough to start a camera, close two epochs and fill a large block


def warm_up_tracker() -> None:
    """Load the compiled code of updates (in a fresh install: compile it), by a drive of its own.

    Otherwise the first updates wait for it: for 0.3 s, and in a fresh install for seconds.
    """
    rig = rig_of("kitti")
    tracker = IncrementalCalibrator(rig)
    table = simulate_correspondences(rig, frames=_FRAMES, matches=_MATCHES)
    for frame in range(_FRAMES):
        tracker.update(table.select(table.frame == frame), frame=frame)
