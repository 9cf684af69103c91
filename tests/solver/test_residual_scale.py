"""The robust spread of residuals."""

from __future__ import annotations

import numpy as np
import pytest

from calibgraph.solver.residual_scale import robust_spread


def test_the_spread_of_a_core_is_found_under_a_broad_background() -> None:
    rng = np.random.default_rng(0)
    for inliers in (1.0, 0.6, 0.3):
        core = np.hypot(*rng.standard_normal((2, 4000))) / 1.17741
        values = np.concatenate([core, rng.uniform(0, 300, round(4000 * (1 / inliers - 1)))])
        assert robust_spread(values) == pytest.approx(1.0, rel=0.05)
    # Values without a core have the spread of all of them.
    assert robust_spread(rng.uniform(0, 300, 4000)) == pytest.approx(150, rel=0.05)
    assert robust_spread(np.zeros(10)) == 0.0
