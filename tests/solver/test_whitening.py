"""Weights, whitening matrices, and errors along what a match constrains."""

from __future__ import annotations

import numpy as np

from calibgraph import (
    Config,
)
from calibgraph.solver.whitening import constrained_error_px, sqrt_information
from tests.model.tables import table


def test_weights_are_the_papers() -> None:
    given = table(confidence=[0.05, 0.25, 1.0, 0.7])
    assert sqrt_information(given, Config()) is None
    roots = sqrt_information(given, Config(confidence_weights=True))
    expected = np.sqrt([0.1, 0.25, 1.0, 0.7])
    np.testing.assert_allclose(roots[:, 0], expected, rtol=1e-6)
    np.testing.assert_allclose(roots[:, 2], expected, rtol=1e-6)
    assert not roots[:, 1].any()


def test_whitening_is_a_root_of_the_information() -> None:
    information = np.array([[4.0, 1.0, 2.0], [1, 1, 1], [0, 0, 9], [9, 0, 0]])
    roots = sqrt_information(table(information_px=information), Config())
    for (uu, uv, vv), (a, b, c) in zip(information, roots, strict=True):
        S = np.array([[a, b], [0, c]])
        np.testing.assert_allclose(S.T @ S, [[uu, uv], [uv, vv]], atol=1e-12)


def test_the_error_of_an_edge_is_the_distance_from_it() -> None:
    residuals = np.array([[3.0, 4.0], [3.0, 4.0], [3.0, 4.0]])
    information = np.array([[1.0, 0, 1], [7.0, 0, 0], [0.5, 0.5, 0.5]])
    expected = [5.0, 3.0, 7 / np.sqrt(2)]
    np.testing.assert_allclose(constrained_error_px(residuals, information), expected)
    np.testing.assert_allclose(constrained_error_px(residuals, None), 5.0)
