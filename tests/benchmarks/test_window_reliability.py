"""The reliability of windows, where it is known."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch")

from benchmarks.accuracy.window_reliability import reliability, stated  # noqa: E402
from benchmarks.accuracy.window_weights import REACH  # noqa: E402

SIDE, COUNT = 2 * REACH + 1, 3000


def windows_that_are_right_as_often_as_they_state() -> np.ndarray:
    """(w, s, s) a peak of three by three shifts; the truth is drawn, and put in the middle."""
    rng, grids = np.random.default_rng(0), np.zeros((COUNT, SIDE, SIDE))
    for grid, height in zip(grids, rng.uniform(0, 9, COUNT), strict=True):
        row, column = rng.integers(4, SIDE - 4, 2)
        grid[row - 1 : row + 2, column - 1 : column + 2] = height
        shares = np.exp(grid) / np.exp(grid).sum()
        truth = np.divmod(rng.choice(SIDE**2, p=shares.ravel()), SIDE)
        grid[:] = np.roll(grid, REACH - np.array(truth), axis=(0, 1))
    return grids


def test_reliable_windows_deviate_by_chance_alone() -> None:
    scores = windows_that_are_right_as_often_as_they_state()
    # Four standard deviations of a share of 600 windows, and 1 % for peaks that are cut at the seam
    # of a rolled grid.
    mean, largest, said, right = map(float, reliability(scores, 1.0))
    assert mean <= largest < 4 * np.sqrt(0.25 / 600) + 0.01
    assert said > 0.9 and right > 0.9
    sure = [float(text) for text in reliability(scores, 3.0)]
    assert sure[1] > 0.3


def test_the_probability_of_the_truth_is_that_of_the_middle() -> None:
    scores = np.zeros((1, SIDE, SIDE))
    scores[0, 0, :] = np.nan
    scores[0, REACH, REACH] = np.log(5.0)
    said, right, truth = stated(scores, 1.0)
    # Of 24 rows of 25, eight shifts of weight 1 and one of 5.
    assert truth[0] == pytest.approx(13 / (24 * 25 + 4))
    assert said[0] == pytest.approx(truth[0]) and right[0]
