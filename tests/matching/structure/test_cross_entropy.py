from __future__ import annotations

import numpy as np

from calibgraph.matching.structure.consensus import maximize


def test_a_tilted_maximum_is_found() -> None:
    rng = np.random.default_rng(0)
    A = rng.standard_normal((6, 6)) + 3 * np.eye(6)
    top = rng.uniform(-0.5, 0.5, 6)
    found, value = maximize(
        lambda points: -(((points - top) @ A) ** 2).sum(axis=1),
        start=np.zeros(6),
        sigmas=np.ones(6),
        half_widths=np.full(6, 2.0),
        samples=200,
        steps=30,
        rng=rng,
    )
    np.testing.assert_allclose(found, top, atol=0.01)  # 30 steps, each about 0.8 as wide
    assert value > -0.01
