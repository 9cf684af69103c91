from __future__ import annotations

import numpy as np
import pytest

from calibgraph.matching.structure.peaks import find_local_peaks
from tests.matching.structure.score_grids import make_grids


def test_peaks_are_found_to_a_fraction_of_a_step() -> None:
    rng = np.random.default_rng(1)
    true = rng.uniform(-6, 6, (50, 2))
    shift, hessian, peak = find_local_peaks(make_grids(true), true + rng.uniform(-1, 1, (50, 2)))
    assert np.isfinite(peak).all()
    np.testing.assert_allclose(shift, true, atol=0.1)
    # The curvature of a Gaussian of sigma 2 at its top, by least squares over +-1 step.
    np.testing.assert_allclose(hessian[:, 0, 0], 0.25, rtol=0.25)
    np.testing.assert_allclose(hessian[:, 0, 1], 0.0, atol=0.02)


def test_an_edge_constrains_only_its_normal() -> None:
    axis = np.arange(-12, 13)
    u, v = np.meshgrid(axis, axis)
    edge = np.exp(-0.5 * (0.6 * u + 0.8 * v - 1.0) ** 2 / 4).astype(np.float32)
    shift, hessian, _ = find_local_peaks(edge[None], np.zeros((1, 2)))
    values, vectors = np.linalg.eigh(hessian[0])
    assert values[0] == pytest.approx(0.0, abs=1e-9)
    assert abs(vectors[:, 1] @ [0.6, 0.8]) == pytest.approx(1.0, abs=1e-3)
    assert shift[0] @ [0.6, 0.8] == pytest.approx(1.0, abs=0.1)


def test_peaks_at_the_rim_are_dropped() -> None:
    _, _, peak = find_local_peaks(make_grids(np.array([[11.0, 0.0]])), np.array([[11.0, 0.0]]))
    assert peak[0] == -np.inf
