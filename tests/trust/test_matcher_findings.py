"""The verdict on a table's findings, and on a matcher that is run again from elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest

import calibgraph
from calibgraph import Correspondences, Rig, simulate_correspondences
from calibgraph.progress import no_progress
from calibgraph.rounds import match_in_rounds
from calibgraph.trust.evidence import by_camera
from calibgraph.trust.matcher_checks import compare_ends
from tests.conftest import SAMPLE

STATED = {"systematic_rotation_rad": 0.0, "systematic_translation_m": 0.0}


@pytest.fixture
def table(pair: Rig) -> Correspondences:
    return calibgraph.simulate_correspondences(pair, frames=8, matches=200)


@pytest.mark.parametrize(
    ("findings", "status"),
    [
        ({}, "PASS"),
        ({"start_dependence": 0.1, "memorization": 0.1, "failed_share": 0.1}, "PASS"),
        ({"start_dependence": 0.3}, "WARN"),
        ({"start_dependence": 0.9}, "FAIL"),
        ({"start_dependence": float("nan")}, "FAIL"),
        ({"memorization": 0.4}, "WARN"),
        ({"memorization": 1.0}, "FAIL"),
        ({"memorization": -0.5}, "PASS"),
        ({"failed_share": 0.5}, "WARN"),
        ({"failed_share": 1.0}, "FAIL"),
    ],
)
def test_findings_decide_the_verdict_of_their_camera(
    pair: Rig, table: Correspondences, findings: dict[str, float], status: str
) -> None:
    metadata = STATED | {key: {"left": value} for key, value in findings.items()}
    verdicts = calibgraph.solve(pair, replace(table, metadata=metadata)).camera_verdicts
    assert verdicts["left"].status == status
    found = [check for check in verdicts["left"].checks if check.status != "PASS"]
    assert len(found) == (status != "PASS")
    assert verdicts["right"].status == "PASS"


def test_a_camera_that_features_place_elsewhere_is_no_pass_with_both_statements(
    pair: Rig, table: Correspondences
) -> None:
    findings = {"found": {"left": 25.0, "right": 30.0}, "contradicted": {"left": "right"}}
    verdicts = calibgraph.solve(pair, replace(table, metadata=STATED | findings)).camera_verdicts
    assert [verdicts[name].status for name in ("left", "right")] == ["WARN", "PASS"]
    found = verdicts["left"].error_probability
    assert found is not None and found.probability < 0.05
    (text,) = (check.text for check in verdicts["left"].checks if check.kind == "contradiction")
    assert "image and cloud agree" in text and "in common with right" in text


FOUND = {"found": {"left": 12.0, "right": 12.0}, "chance": {"left": 2e-4, "right": 1e-6}}


def at_z_score(value: float) -> dict[str, Any]:
    return STATED | {"z_score": {"left": value, "right": value}}


def test_a_search_that_measured_chance_is_judged_by_that_where_it_ends_well(pair: Rig) -> None:
    """In one frame, which all checks that count data are about."""
    table = calibgraph.simulate_correspondences(pair, frames=1, matches=200)
    metadata = at_z_score(8.5)
    blamed = calibgraph.solve(pair, replace(table, metadata=metadata)).camera_verdicts
    assert blamed["left"].status == "FAIL"
    verdicts = calibgraph.solve(pair, replace(table, metadata=metadata | FOUND)).camera_verdicts
    assert verdicts["left"].status == verdicts["right"].status == "WARN"
    assert verdicts["left"].cannot_tell
    kinds = {check.kind for check in verdicts["left"].checks}
    assert "chance" in kinds and "z_score" not in kinds
    by_checks = [verdicts[name].error_probability.by_checks for name in ("left", "right")]  # type: ignore[union-attr]
    assert by_checks[0] - by_checks[1] == pytest.approx(2e-4, rel=0.02)


@pytest.mark.parametrize(("frames", "z_score"), [(1, 1.0), (3, 5.0), (4, 8.5), (30, 1.0)])
def test_what_a_search_found_excuses_neither_a_lost_end_nor_many_frames(
    pair: Rig, frames: int, z_score: float
) -> None:
    """The verdict is then that of a table without the search's findings."""
    table = calibgraph.simulate_correspondences(pair, frames=frames, matches=200)
    without, with_search = (
        calibgraph.solve(pair, replace(table, metadata=metadata)).camera_verdicts["left"]
        for metadata in (at_z_score(z_score), at_z_score(z_score) | FOUND)
    )
    assert with_search.status == "FAIL"
    assert with_search.error_probability == without.error_probability


def test_a_camera_that_few_frames_do_not_show_fails_for_that_reason(pair: Rig) -> None:
    """Neither swapped images nor pairing are blamed; the other camera keeps its verdict."""
    swapped = dict(zip(pair.cameras, reversed(pair.T_camera_lidar.values()), strict=True))
    table = calibgraph.simulate_correspondences(pair, frames=1, matches=200)
    metadata = STATED | {
        "z_score": {"left": 3.0, "right": 9.0},
        "found": {"right": 12.0},
        "missed": {"left": 8.0},
        "chance": {"left": 0.3, "right": 1e-5},
    }
    guess = pair.moved_to({"left": swapped["left"]})  # the result of the left is at the other's
    result = calibgraph.solve(guess, replace(table, metadata=metadata))
    first = result.summary.reasons[0]
    assert first.cameras == ("left",) and first.text.startswith("not found: ")
    assert "with a probability of 0.3" in first.text
    assert result.summary.actions[0].startswith("left: Record at least 5 frames")
    assert not [text for text in result.verdict.reasons if "swapped" in text]
    assert result.camera_verdicts["right"].status == "WARN"


class Simulated:
    """A matcher whose correspondences fit one rig after the other, with rounds for near starts."""

    rounds, stage1, tracking_rounds = 1, "rig", (0,)

    def __init__(self, *seen: Rig, z_scores: Sequence[dict[str, float]] = ()) -> None:
        self.seen, self.z_scores = [*seen], [*z_scores]

    def match(self, dataset, rig, *, round_index, progress):  # noqa: ANN001, ANN201
        table = simulate_correspondences(self.seen.pop(0), frames=6, matches=100)
        return (
            replace(table, metadata={"z_score": self.z_scores.pop(0)}) if self.z_scores else table
        )


@pytest.fixture
def truth() -> Rig:
    return calibgraph.load_rig(SAMPLE / "reference.yaml")


@pytest.mark.usefixtures("no_image_checks")
@pytest.mark.parametrize(("deg", "status"), [(0.0, "PASS"), (1.0, "FAIL")])
def test_a_matcher_that_comes_back_passes_and_one_that_ends_elsewhere_fails(
    truth: Rig, deg: float, status: str
) -> None:
    end = calibgraph.perturb(truth, rotation_deg=deg, translation_m=deg / 10, seed=1)
    matched = match_in_rounds(SAMPLE, truth, Simulated(truth, end), progress=no_progress)
    for checks in by_camera(truth.cameras, compare_ends(matched)).values():
        assert [check.status for check in checks][:1] == [status]
        assert checks[0].value == pytest.approx(deg, abs=0.02)


@pytest.mark.usefixtures("no_image_checks")
def test_a_camera_is_taken_from_where_image_and_cloud_agree_clearly_better(truth: Rig) -> None:
    """All cameras end 8 cm off at first; only of one is the second end clearly better."""
    off = calibgraph.perturb(truth, rotation_deg=0.1, translation_m=0.08, seed=1)
    agreed = [
        {"front_left": 16.0, "front_right": 20.0, "left": 18.0},
        {"front_left": 18.0, "front_right": 20.1, "left": 17.0},
    ]

    matched = match_in_rounds(
        SAMPLE, truth, Simulated(off, truth, z_scores=agreed), progress=no_progress
    )
    errors = calibgraph.evaluate(matched.solution.solved_rig, truth).cameras
    assert errors["front_left"].translation_error_cm < 1
    for name in ("front_right", "left"):
        assert errors[name].translation_error_cm == pytest.approx(8, abs=1)
    expected = {"front_left": 18.0, "front_right": 20.0, "left": 18.0}
    assert matched.correspondences.metadata["z_score"] == expected
    ends = by_camera(truth.cameras, compare_ends(matched))
    for checks in ends.values():  # two different ends are a warning
        assert checks[1].status == "WARN" and checks[1].value == pytest.approx(8, abs=1)
    began = calibgraph.evaluate(matched.solution.rig, truth).cameras
    assert began["left"].translation_error_cm < 1e-6  # the guess, of the first rounds
    assert began["front_left"].translation_error_cm > 1  # of the second, displaced from an end
