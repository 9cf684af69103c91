"""Differences of results of disjoint frames."""

from __future__ import annotations

from dataclasses import asdict, replace

import gtsam
import numpy as np
import pytest

from benchmarks.accuracy import disjoint
from benchmarks.accuracy.disjoint import difference, repeat_covariances, report, split
from benchmarks.accuracy.ledger import Key, Record
from calibgraph import Rig, solve
from tests.trust.conftest import simulated

KEY = Key("halves", "random", "05", 0)


def moved(xi: np.ndarray) -> np.ndarray:
    return np.array(gtsam.Pose3.Expmap(xi).matrix())


def test_halves_are_disjoint_cover_all_frames_and_change_with_the_seed() -> None:
    first, second = split(25, 3)
    assert (len(first), len(second)) == (12, 13)
    assert sorted([*first, *second]) == [*range(25)]
    assert split(25, 4)[0] != first == sorted(first)


def test_right_error_bars_give_one_and_95_percent() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6)) * 1e-3  # small: rotations add up as vectors
    bars = (root @ root.T, np.diag(np.array([1, 2, 3, 4, 5, 6]) * 1e-6))
    draws = 2000
    noise = [rng.multivariate_normal(np.zeros(6), bar, draws) for bar in bars]

    def both(i: int) -> Record:
        results = ((moved(noise[k][i]), 2 * bars[k], "PASS", bars[k]) for k in range(2))
        return {**asdict(KEY), "cameras": {"left": difference(*results)}}

    rows = report([both(i) for i in range(draws)]).rows
    found = dict(zip(disjoint.COLUMNS, rows[-1], strict=True))
    # the mean of chi-squared of 6, over 6, scatters by sqrt(2 / 6 / draws) = 0.013, the share by
    # sqrt(0.95 * 0.05 / draws) = 0.5 %
    assert float(found["squared in its covariance, over 6"]) == pytest.approx(0.5, abs=0.03)
    assert float(found["without what all share"]) == pytest.approx(1, abs=0.05)
    assert float(found["of these in the 95 % region"].rstrip("%")) == pytest.approx(95, abs=2)
    assert found["both PASS"] == str(draws)


def test_repeats_lack_what_all_places_share(pair: Rig) -> None:
    table = simulated(pair)
    shared = {"systematic_rotation_rad": 0.01, "systematic_translation_m": 0.1}
    stated = solve(pair, replace(table, metadata={**table.metadata, **shared}))
    for name, repeats in repeat_covariances(stated).items():
        whole = stated.covariance[name]
        assert whole is not None
        assert np.sqrt(np.diag(whole))[:3] == pytest.approx(0.01, rel=0.2)
        assert (np.diag(repeats) < 0.05 * np.diag(whole)).all()
