"""The rounds of an audit: as few as settle, with every file decoded once."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

import calibgraph
from calibgraph import Correspondences, Dataset, Rig, simulate_correspondences
from calibgraph.audit.matching import Matching, match_from_deployed
from calibgraph.io.frame import Frame
from calibgraph.io.kept_frames import KeptFrame, keep_frames
from calibgraph.matching.protocol import FullMatcher
from calibgraph.model.config import Config
from calibgraph.model.findings import MatcherFindings
from calibgraph.progress import Progress, Stopwatch, no_progress
from tests.audit.deployed import TRUTH, motion, with_camera_moved
from tests.conftest import SAMPLE

TABLE = simulate_correspondences(TRUTH, frames=6)


@dataclass
class MatcherOfTruth:
    """Finds the correspondences of the truth in every round; notes which rounds were asked for."""

    z_score: float = 40.0
    camera_without: str = ""
    rounds: int = 5
    stage1: str = "rig"
    tracking_rounds: tuple[int, ...] = (2, 4)
    asked: list[int] = field(default_factory=list)

    def match(
        self, dataset: Dataset, rig: Rig, *, round_index: int, progress: Progress
    ) -> Correspondences:
        self.asked.append(round_index)
        findings = MatcherFindings(z_score=dict.fromkeys(rig.cameras, self.z_score))
        table = replace(TABLE, metadata={**TABLE.metadata, **findings.to_metadata()})
        missing = self.camera_without and self.asked == [4]
        if not missing:
            return table
        return table.select(table.camera_index != table.cameras.index(self.camera_without))


def rounds_from(deployed: Rig, matcher: MatcherOfTruth) -> list[int]:
    """The rounds that are run from a deployed rig."""
    data, config = calibgraph.load_dataset(SAMPLE, TRUTH), Config().changed(stage1="rig")
    matching = Matching(data, deployed, FullMatcher(matcher), config, no_progress)
    match_from_deployed(matching, Stopwatch())
    return matcher.asked


@pytest.mark.parametrize(
    ("metres", "rounds"),
    [
        (0.0, [4]),
        (0.03, [4]),
        (0.06, [4, 2, 4]),  # beyond the motion of a last round
        (0.30, [4, 2, 4, 0, 2, 4]),  # and beyond the reach of the tracking rounds
    ],
)
def test_more_rounds_are_run_the_farther_the_deployed_rig_is_off(
    metres: float, rounds: list[int]
) -> None:
    deployed = with_camera_moved(TRUTH, "left", motion(0, metres=metres))
    assert rounds_from(deployed, MatcherOfTruth()) == rounds


def test_a_low_z_score_does_not_confirm_the_deployed_rig() -> None:
    assert rounds_from(TRUTH, MatcherOfTruth(z_score=12.0)) == [4, 2, 4, 0, 2, 4]


def test_a_camera_without_matches_does_not_confirm_the_deployed_rig() -> None:
    """It is held where it is deployed, which is no measurement."""
    assert rounds_from(TRUTH, MatcherOfTruth(camera_without="left")) == [4, 2, 4]


def test_files_are_decoded_once(monkeypatch: pytest.MonkeyPatch) -> None:
    data, camera = calibgraph.load_dataset(SAMPLE, TRUTH), TRUTH.cameras["left"]
    plain = [(f.load_cloud(), f.load_gray("left", camera)) for f in data.frames]
    read = Counter[str]()

    def counted(name: str) -> None:
        load = getattr(Frame, name)

        def load_and_count(frame: Frame, *of: Any) -> Any:
            read[f"{name} {frame.name}"] += 1
            return load(frame, *of)

        monkeypatch.setattr(Frame, name, load_and_count)

    counted("load_cloud")
    counted("load_gray")
    kept = keep_frames(data)
    for _ in range(2):
        for frame, (cloud, gray) in zip(kept.frames, plain, strict=True):
            np.testing.assert_array_equal(frame.load_cloud(), cloud)
            np.testing.assert_array_equal(frame.load_gray("left", camera), gray)
    assert len(read) == 2 * len(data.frames)
    assert set(read.values()) == {1}


def test_kept_frames_are_those_of_the_dataset() -> None:
    data = calibgraph.load_dataset(SAMPLE, TRUTH)
    for kept, frame in zip(keep_frames(data).frames, data.frames, strict=True):
        assert (kept.index, kept.name, kept.motion) == (frame.index, frame.name, frame.motion)
        assert (kept.entry(), kept.hashes()) == (frame.entry(), frame.hashes())


def test_an_audit_keeps_no_decoded_frames() -> None:
    audit = calibgraph.check(TRUTH, SAMPLE, matcher=TABLE)
    assert not isinstance(audit.shown, KeptFrame)
