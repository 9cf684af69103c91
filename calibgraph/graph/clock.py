"""The clock of a camera among the parameters of its variable in ``calibgraph.graph.lens``.

    offset   of the middle row of an image to the points of its frame
    readout  from the first row to the last

Matches show them where the LiDAR moves: its twist comes with the correspondences. Constant motion
straight ahead shows no offset, which is then a translation; at rest the columns are zero, and the
parameters stay at their prior.
"""

from __future__ import annotations

from collections.abc import Iterable

from calibgraph.model.config import LensPart
from calibgraph.model.rig import Camera
from factors import Clock
from factors.columns import OFFSET, READOUT

OFFSET_SIGMA_S, READOUT_SIGMA_S = 0.05, 0.03
"""Of the prior, where the rig states none: half a turn of a LiDAR, and a usual read-out."""


def clock_sigmas(camera: Camera) -> dict[LensPart, float]:
    """The prior standard deviation of each parameter [s]."""
    return {
        "offset": camera.time_offset_sigma_s or OFFSET_SIGMA_S,
        "readout": camera.readout_sigma_s or READOUT_SIGMA_S,
    }


def put_clock_into(camera: Camera, clock: Clock, free: Iterable[str]) -> Camera:
    """A camera with the free parameters of a clock."""
    times = {OFFSET: ("time_offset_s", clock.offset_s), READOUT: ("readout_s", clock.readout_s)}
    return camera.model_copy(update=dict(times[name] for name in free if name in times))
