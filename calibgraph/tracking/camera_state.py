"""The state of one camera of the tracker."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.correspondences import Correspondences
from calibgraph.solver.robust import ResidualScale
from calibgraph.tracking.epoch_summary import EpochSummary
from calibgraph.tracking.frozen import changed
from calibgraph.tracking.live_frames import OutlierFrame
from calibgraph.tracking.noise import GroupScatter, ResidualHistogram, median, no_groups


@dataclass(frozen=True, eq=False)
class CameraState:
    """The state of one camera.

    Attributes:
        started: whether it has an estimate of its own.
        waiting: before that, the frames it may start from.
        refused: why it has not started from them.
        residuals: their histogram.
        scale: of the residuals, as of the beginning of the last epoch.
        recent: (f, 2) of its last absorbed frames: the share of inliers, the median error [px].
        summary: of its older epochs.
        outlier_frames: its last frames that disagree with the estimate but fit another one, newest
            last.
        agreements: of its last frames, newest last: its number, and whether it agreed.
        absent: frames since the last usable one.
        groups: scatter of groups of epochs, by which errors shared by neighbouring frames show.
        moved_at: number of updates when it last moved, or -1.
        drift_reported_at: number of updates when its drift was last reported, or -1.
        counts: of frames and correspondences that were given, used, left out.
    """

    started: bool = False
    waiting: tuple[Correspondences, ...] = ()
    refused: tuple[str, ...] = ()
    residuals: ResidualHistogram = field(default_factory=ResidualHistogram)
    scale: ResidualScale = ResidualScale(1.0, 1.0, 1.0, 1.0)
    recent: Array = field(default_factory=lambda: np.empty((0, 2)))
    summary: EpochSummary = field(default_factory=EpochSummary.empty)
    outlier_frames: tuple[OutlierFrame, ...] = ()
    agreements: tuple[tuple[int, bool], ...] = ()
    absent: int = 0
    groups: tuple[GroupScatter, ...] = field(default_factory=no_groups)
    moved_at: int = -1
    drift_reported_at: int = -1
    counts: dict[str, int] = field(default_factory=dict)

    @property
    def inlier_share(self) -> float:
        """Median share of inliers of the last absorbed frames."""
        return median(self.recent[:, 0])

    def count(self, **more: int) -> CameraState:
        """The camera with some counts raised."""
        counts = dict(self.counts)
        for key, number in more.items():
            counts[key] = counts.get(key, 0) + number
        return changed(self, counts=counts)
