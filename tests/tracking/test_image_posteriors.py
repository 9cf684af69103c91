"""The frames whose images are scored at the end of a drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pytest

from calibgraph import Calibration, Config, IncrementalCalibrator, Rig
from calibgraph.arrays import Array
from calibgraph.model.config import Tracking
from calibgraph.model.geometry import relative_transform
from calibgraph.model.rig import RelativePose
from calibgraph.trust.pose_posterior import PosePosterior
from tests.tracking.drives import drive, flat, pair_of

SHORT = Config(tracking=Tracking(epoch_frames=4, live_epochs=2))
"""Of 14 frames the last ten are live, of 22 the last 10."""


def rig_of(*, tied: bool) -> Rig:
    rig = pair_of()
    T = rig.T_camera_lidar
    pair = RelativePose(
        a="left",
        b="right",
        T_a_b=relative_transform(T["left"], T["right"]),
        rotation_sigma_rad=1e-3,
        translation_sigma_m=1e-2,
    )
    return rig.model_copy(update={"relative_poses": (pair,) if tied else ()})


class Scorer:
    """Notes which groups are asked for, by frames."""

    def __init__(self) -> None:
        self.asked: dict[tuple[int, ...], list[tuple[str, ...]]] = {}

    def __call__(
        self, numbers: Sequence[int], known: Mapping[str, Array], groups: Sequence[Sequence[str]]
    ) -> dict[str, PosePosterior]:
        self.asked[tuple(numbers)] = [tuple(group) for group in groups]
        return {name: flat(0.02, 0.3) for group in groups for name in group}


def result_of(scorer: Scorer, frames: int, *, tied: bool, **blind: Any) -> Calibration:
    rig = rig_of(tied=tied)
    tracker = IncrementalCalibrator(rig, SHORT)
    for number, table in enumerate(drive(rig, frames, blind=blind)):
        tracker.update(table, frame=number)
    return tracker.calibration(scorer)


LEFT, RIGHT, BOTH = ("left",), ("right",), ("left", "right")


@pytest.mark.parametrize(
    ("tied", "blind", "asked"),
    [
        (True, {}, {range(4, 14): [BOTH]}),
        (False, {}, {range(4, 14): [LEFT, RIGHT]}),
        (True, {"right": [7]}, {(4, 5, 6, *range(8, 14)): [BOTH]}),
        (False, {"right": [7]}, {range(4, 14): [LEFT], (4, 5, 6, *range(8, 14)): [RIGHT]}),
        *(
            (
                tied,
                {"left": range(1, 14, 2), "right": range(0, 14, 2)},
                {range(4, 14, 2): [LEFT], range(5, 14, 2): [RIGHT]},
            )
            for tied in (True, False)
        ),
        *(
            (tied, {"right": range(6, 14)}, {range(4, 14): [LEFT], (4, 5): [RIGHT]})
            for tied in (True, False)
        ),
    ],
)
def test_cameras_are_scored_on_frames_that_show_them(
    tied: bool, blind: Any, asked: dict[Sequence[int], list[tuple[str, ...]]]
) -> None:
    """Tied ones on common frames, if there are enough."""
    scorer = Scorer()
    result = result_of(scorer, 14, tied=tied, **blind)
    assert scorer.asked == {tuple(frames): groups for frames, groups in asked.items()}
    for verdict in result.camera_verdicts.values():
        assert "flat_evidence" in {check.kind for check in verdict.checks}
