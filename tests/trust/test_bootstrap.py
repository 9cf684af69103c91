from __future__ import annotations

import numpy as np
import pytest

from calibgraph import Config, Rig, solve
from tests.trust.conftest import named, simulated


def test_the_bootstrap_agrees_with_the_reported_covariance(pair: Rig) -> None:
    config = Config(bootstrap=100)
    table = simulated(pair, frames=30)
    result, again = solve(pair, table, config), solve(pair, table, config)
    for name, covariance in result.bootstrap.items():
        np.testing.assert_array_equal(covariance, again.bootstrap[name])
        ratio = np.sqrt(np.diag(covariance) / np.diag(result.covariance[name]))
        # Of the reported variance 8 / 38 stand for what 30 frames leave unsaid; 100 draws give
        # a standard deviation to 7 %.
        assert (ratio > 0.65).all() and (ratio < 1.15).all()
        (check,) = named(result, name, "bootstrap")
        # The check's scatter is of both cameras jointly, the reported one of each by itself.
        assert check.status == "PASS" and check.value == pytest.approx(ratio.max(), rel=0.1)
