"""Scaling to a unit diagonal: units do not matter, free directions show."""

from __future__ import annotations

import numpy as np
import pytest

from factors import smallest_scaled_eigenvalue, unit_diagonal


def random_hessian(seed: int = 0) -> np.ndarray:
    root = np.random.default_rng(seed).standard_normal((9, 6))
    return root.T @ root


def test_the_diagonal_becomes_one_and_the_units_undo_it() -> None:
    hessian = random_hessian()
    scaled, units = unit_diagonal(hessian)
    np.testing.assert_allclose(np.diag(scaled), 1.0, rtol=1e-15)
    np.testing.assert_allclose(scaled * np.outer(units, units), hessian, rtol=1e-14)


def test_the_smallest_eigenvalue_does_not_depend_on_units() -> None:
    hessian = random_hessian()
    units = np.repeat([1e-3, 1e4], 3)
    expected = smallest_scaled_eigenvalue(hessian)
    assert 0 < expected < 1
    # Rounding of a 6x6 eigenvalue problem with eigenvalues up to 6.
    found = smallest_scaled_eigenvalue(hessian * np.outer(units, units))
    assert found == pytest.approx(expected, abs=1e-14)
    assert smallest_scaled_eigenvalue(np.diag([1e-9, 1.0, 1e9])) == pytest.approx(1.0)


def test_a_free_unknown_or_direction_gives_zero() -> None:
    hessian = random_hessian()
    free = hessian.copy()
    free[2], free[:, 2] = 0.0, 0.0
    assert smallest_scaled_eigenvalue(free) == 0.0
    assert unit_diagonal(free)[1][2] == 1.0
    direction = np.ones(6) / np.sqrt(6)
    projected = np.eye(6) - np.outer(direction, direction)
    assert abs(smallest_scaled_eigenvalue(projected @ hessian @ projected)) < 1e-14
