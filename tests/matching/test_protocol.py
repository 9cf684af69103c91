"""The matcher protocol: what a matcher of your own needs, and what it may have."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

import calibgraph
from calibgraph import Config, Correspondences, Dataset, Rig
from calibgraph.errors import CorrespondenceError
from calibgraph.matching.named import find_matcher
from calibgraph.matching.protocol import FullMatcher, Start
from calibgraph.model.findings import MatcherFindings
from calibgraph.progress import Progress, no_progress
from calibgraph.rounds import match_in_rounds
from factors import Clock
from tests.conftest import SAMPLE
from tests.draws.clocks import draw_twists, put_clock_error


class Minimal:
    """The least: as the class in the README."""

    rounds, stage1 = 1, "pnp"

    def match(self, dataset, rig, *, round_index, progress):  # noqa: ANN001, ANN201
        return simulate(dataset, rig)


@dataclass
class Complete:
    """Every member; its images show the truth. It records its calls."""

    truth: Rig
    rounds: int = 3
    stage1: str = "rig"
    most_frames: int | None = 2
    image_checks_can_fail: bool = True
    tracking_rounds: tuple[int, ...] = (1,)
    calls: list[tuple[str, int, float]] = field(default_factory=list)

    def locate(
        self, dataset: Dataset, rig: Rig, *, out_of_time: Callable[[], bool], progress: Progress
    ) -> Start:
        self.calls.append(("locate", len(dataset.frames), self.error_m(rig)))
        assert not out_of_time()
        findings = MatcherFindings(found=dict.fromkeys(rig.cameras, 21.0), range_rotation_deg=7.0)
        return Start(self.truth, first_round=1, findings=findings)

    def match(
        self, dataset: Dataset, rig: Rig, *, round_index: int, progress: Progress
    ) -> Correspondences:
        self.calls.append((f"match {round_index}", len(dataset.frames), self.error_m(rig)))
        findings = MatcherFindings(z_score=dict.fromkeys(rig.cameras, 20.0))
        return replace(simulate(dataset, self.truth), metadata=findings.to_metadata())

    def release(self) -> None:
        self.calls.append(("release", 0, 0.0))

    def error_m(self, rig: Rig) -> float:
        errors = calibgraph.evaluate(rig, self.truth).cameras.values()
        return max(error.translation_error_cm for error in errors) / 100


def simulate(dataset: Dataset, rig: Rig) -> Correspondences:
    return calibgraph.simulate_correspondences(rig, frames=len(dataset.frames), matches=100)


@pytest.fixture(scope="module")
def one(truth: Rig) -> Rig:
    """A rig of one camera."""
    return Rig(cameras={"left": truth.cameras["left"]})


@pytest.fixture(scope="module")
def guess(truth: Rig) -> Rig:
    return calibgraph.perturb(truth, rotation_deg=3.0, translation_m=0.3, seed=0)


def test_a_matcher_may_know_what_is_estimated_beside_the_pose() -> None:
    class Knowing(Minimal):
        def with_estimate(self, parts):  # noqa: ANN001, ANN202
            other = Knowing()
            other.rounds = 1 + len(parts)
            return other

    plain, knowing = (FullMatcher(each) for each in (Minimal(), Knowing()))
    assert plain.with_estimate(("focal",)) is plain
    assert knowing.with_estimate(("focal", "offset")).rounds == 3


def test_a_clock_without_a_motion_is_refused_before_any_work(one: Rig) -> None:
    """Not of a matcher that knows the motion, which frames do not."""

    class Knowing(Minimal):
        knows_motion = True

        def match(self, dataset, rig, *, round_index, progress):  # noqa: ANN001, ANN202
            found = super().match(dataset, rig, round_index=round_index, progress=progress)
            return replace(found, twist_per_s=np.zeros((len(found), 6)))

    matcher, config = Complete(one), Config(estimate=("offset",))
    data = calibgraph.load_dataset(SAMPLE, one)
    with pytest.raises(CorrespondenceError, match="offset, the motion of the LiDAR must be known"):
        match_in_rounds(data, matcher=matcher, config=config, progress=no_progress)
    assert matcher.calls == []
    run = match_in_rounds(data, matcher=Knowing(), config=config, progress=no_progress)
    assert {one.name for lens in run.solution.lens.values() for one in lens} == {"offset"}


def test_a_clock_that_does_not_settle_is_warned_of(one: Rig) -> None:
    """Every match is of another offset: four repeats, then a line."""
    offsets_s = [0.0, 0.05, 0.1, 0.15, 0.2, 0.25]

    class Restless(Minimal):
        knows_motion = True

        def match(self, dataset, rig, *, round_index, progress):  # noqa: ANN001, ANN202
            twists = draw_twists(len(dataset.frames), np.random.default_rng(0))
            return put_clock_error(simulate(dataset, one), one, twists, Clock(offsets_s.pop(0)))

    run = match_in_rounds(
        calibgraph.load_dataset(SAMPLE, one),
        matcher=Restless(),
        config=Config(estimate=("offset",)),
        progress=no_progress,
    )
    assert len(run.rounds) == 5
    assert run.warnings[-1].startswith("offset: after 4 repeats of the matching still changes by")


def test_every_member_is_used_in_its_turn(truth: Rig, guess: Rig) -> None:
    matcher = Complete(truth)
    data = calibgraph.load_dataset(SAMPLE, guess)
    run = match_in_rounds(data, matcher=matcher, progress=no_progress)
    located, first, second, near, last, end = matcher.calls
    assert located[:2] == ("locate", 2) and located[2] > 0.2  # most_frames, from the guess
    assert first == ("match 1", 2, pytest.approx(0.0, abs=1e-9))  # first_round, from the start
    assert second[0] == "match 2"
    assert (near[0], last[0]) == ("match 1", "match 2")  # tracking_rounds, then the last round
    assert near[2] > 0.05 > last[2]  # from a displaced start
    assert end[0] == "release"
    assert run.rematch.keys() == truth.cameras.keys() and not run.rematch_failure
    assert run.matcher.image_checks_can_fail
    found = run.correspondences.findings
    assert found.z_score == dict.fromkeys(truth.cameras, 20.0), "of the last round"
    assert found.found == dict.fromkeys(truth.cameras, 21.0), "of the start"
    assert found.range_rotation_deg == 7.0


FINDINGS = MatcherFindings(
    z_score={"left": 17.5},
    start_dependence={"left": 0.1},
    memorization={"left": 0.9},
    failed_share={"left": 0.25},
    found={"left": 18.0},
    missed={"right": 3.0},
    chance={"left": 1e-5, "right": 0.7},
    range_rotation_deg=20.0,
    range_translation_m=1.5,
    systematic_rotation_rad=0.001,
    systematic_translation_m=0.02,
)


def test_findings_survive_a_file(truth: Rig, tmp_path: Path) -> None:
    table = calibgraph.simulate_correspondences(truth, frames=1, matches=10)
    replace(table, metadata=FINDINGS.to_metadata()).save(tmp_path / "table.parquet")
    assert calibgraph.load_correspondences(tmp_path / "table.parquet").findings == FINDINGS


@pytest.fixture(scope="module")
def table(truth: Rig) -> Correspondences:
    return calibgraph.simulate_correspondences(truth, frames=4, matches=20)


@pytest.mark.parametrize("source", ["memory", ".parquet", ".csv"])
def test_a_table_matches_the_frames_of_the_dataset(
    table: Correspondences, truth: Rig, tmp_path: Path, source: str
) -> None:
    path = tmp_path / f"table{source}"
    if source != "memory":
        table.save(path)
    matcher = find_matcher(table if source == "memory" else path)
    data = calibgraph.load_dataset(SAMPLE, truth).select("1:3")
    rows = matcher.match(data, truth, round_index=0, progress=no_progress)
    assert set(np.unique(rows.frame)) == {1, 2}
    assert len(rows) == np.count_nonzero(np.isin(table.frame, (1, 2)))
    assert (matcher.rounds, matcher.stage1, matcher.tracking_rounds) == (1, "pnp", ())
