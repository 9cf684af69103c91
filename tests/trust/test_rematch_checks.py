from __future__ import annotations

from dataclasses import replace

import pytest

import calibgraph
from calibgraph import Rig, simulate_correspondences
from calibgraph.rounds import match_in_rounds
from calibgraph.trust.rematch_checks import compare_ends
from tests.conftest import SAMPLE


def silent(what: str, done: int, total: int) -> None:
    """No-op progress callback."""


class Simulated:
    """A matcher whose correspondences fit one rig after the other, with rounds for near starts."""

    rounds, stage1, tracking_rounds = 1, "rig", (0,)

    def __init__(self, seen: list[Rig]) -> None:
        self.seen = seen

    def match(self, dataset, rig, *, round_index, progress):  # noqa: ANN001, ANN201
        return simulate_correspondences(self.seen.pop(0), frames=6, matches=100)


class Scored(Simulated):
    """A simulated matcher that also reports z-scores."""

    def __init__(self, seen: list[Rig], z_scores: list[dict[str, float]]) -> None:
        super().__init__(seen)
        self.z_scores = z_scores

    def match(self, dataset, rig, *, round_index, progress):  # noqa: ANN001, ANN201
        table = super().match(dataset, rig, round_index=round_index, progress=progress)
        return replace(table, metadata={"z_score": self.z_scores.pop(0)})


@pytest.fixture
def truth() -> Rig:
    return calibgraph.load_rig(SAMPLE / "reference.yaml")


def test_a_matcher_that_comes_back_passes(truth: Rig) -> None:
    matched = match_in_rounds(SAMPLE, truth, Simulated([truth, truth]), progress=silent)
    for checks in compare_ends(matched.rematch).values():
        assert [check.status for check in checks] == ["PASS", "PASS"]


def test_a_matcher_that_ends_elsewhere_fails(truth: Rig) -> None:
    other = calibgraph.perturb(truth, rotation_deg=1, translation_m=0.1, seed=1)
    matched = match_in_rounds(SAMPLE, truth, Simulated([truth, other]), progress=silent)
    for checks in compare_ends(matched.rematch).values():
        assert checks[0].status == "FAIL" and checks[0].value == pytest.approx(1.0, abs=0.02)


def test_a_camera_is_taken_from_where_image_and_cloud_agree_clearly_better(truth: Rig) -> None:
    """All cameras end 8 cm off at first; only of one is the second end clearly better."""
    off = calibgraph.perturb(truth, rotation_deg=0.1, translation_m=0.08, seed=1)
    agreed = [
        {"front_left": 16.0, "front_right": 20.0, "left": 18.0},
        {"front_left": 18.0, "front_right": 20.1, "left": 17.0},
    ]

    matched = match_in_rounds(SAMPLE, truth, Scored([off, truth], agreed), progress=silent)
    errors = calibgraph.evaluate(matched.solution.solved_rig, truth).cameras
    assert errors["front_left"].translation_error_cm < 1
    for name in ("front_right", "left"):
        assert errors[name].translation_error_cm == pytest.approx(8, abs=1)
    expected = {"front_left": 18.0, "front_right": 20.0, "left": 18.0}
    assert matched.correspondences.metadata["z_score"] == expected
    for checks in compare_ends(matched.rematch).values():  # two different ends are a warning
        assert checks[1].status == "WARN" and checks[1].value == pytest.approx(8, abs=1)
    began = calibgraph.evaluate(matched.solution.rig, truth).cameras
    assert began["left"].translation_error_cm < 1e-6  # the guess, of the first rounds
    assert began["front_left"].translation_error_cm > 1  # of the second, displaced from an end
