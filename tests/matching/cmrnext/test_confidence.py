"""Confidence of matches."""

from __future__ import annotations

import numpy as np
import pytest

from calibgraph.matching.cmrnext import confidence


def test_confidence_falls_with_each_factor() -> None:
    sure = confidence.from_flow(np.zeros(1), np.ones(1))
    assert 0.9 < sure[0] <= 1
    assert confidence.from_flow(np.full(1, 2.0), np.ones(1)) < 0.5 * sure
    assert confidence.from_flow(np.zeros(1), np.full(1, 1 / 81)) < 0.6 * sure
    assert confidence.lower_by_residuals(sure, np.full(1, 4.0)) == pytest.approx(sure / 2)
    assert confidence.from_flow(np.array([np.nan]), np.ones(1)) > 0  # and no NaN
