"""Sums over places: in constant memory, and what is in them."""

from __future__ import annotations

import numpy as np
import pytest

from calibgraph.tracking.place_sums import MOST_PLACES, PlaceSums
from calibgraph.tracking.sums import Sums

Array = np.ndarray


def part(name: str, seed: int, frames: int = 3) -> dict[str, Sums]:
    """Sums of two cameras at a place."""
    rng = np.random.default_rng(seed)
    roots, scores = rng.standard_normal((2, 6, 6)), rng.standard_normal((frames, 2, 6))
    hessian = roots @ roots.swapaxes(1, 2)
    return {
        name: Sums.of(
            hessian=hessian,
            gradient=rng.standard_normal((2, 6)),
            reweighted=hessian,
            score=scores.sum(axis=0),
            scatter=np.einsum("fni,fnj->nij", scores, scores),
            frames=np.full(2, float(frames)),
            matches=np.full(2, 100.0 * frames),
        )
    }


def sums_of(*parts: dict[str, Sums]) -> PlaceSums:
    found = PlaceSums.empty(2)
    for one in parts:
        found = found.add(one)
    return found


def test_older_places_are_one_row_that_counts_as_many() -> None:
    """Nothing is lost of the sums, and nothing of the scatter about the places' means."""
    names = [str(number) for number in range(MOST_PLACES + 5)]
    whole = sums_of(*(part(name, int(name)) for name in names))
    bounded = whole.bounded()
    assert bounded.names[1:] == tuple(names[5:])
    np.testing.assert_allclose(bounded.places[0], 5.0)
    np.testing.assert_allclose(bounded.rows.total().hessian, whole.rows.total().hessian)
    for found, expected in zip(bounded.within_places, whole.within_places, strict=True):
        np.testing.assert_allclose(found, expected)


def test_a_camera_restarts_without_the_others() -> None:
    sums = sums_of(part("a", 0), part("b", 1)).bounded(most=1)
    left = sums.without(0)
    assert not left.frames[:, 0].any() and not left.rows.scatter[:, 0].any() and not left.means[0]
    np.testing.assert_array_equal(left.rows.hessian[:, 1], sums.rows.hessian[:, 1])
    np.testing.assert_array_equal(left.rows.scatter[:, 1], sums.rows.scatter[:, 1])


@pytest.mark.parametrize("name", ["b", "c"])
def test_what_a_drift_leaves_is_of_one_place(name: str) -> None:
    """The drift discounts the sums, of which none are kept place by place."""
    sums = sums_of(part("a", 0), part("b", 1))
    none, scatter = Sums.zeros(), 3 * np.eye(6)
    held = none.change(hessian=2 * np.eye(6), scatter=scatter, frames=np.array(7.5))
    found = sums.with_camera_at(name, 1, held)
    row = found.names.index(name)
    np.testing.assert_array_equal(
        found.frames[:, 1], [7.5 * (n == row) for n in range(len(found.names))]
    )
    np.testing.assert_array_equal(found.rows.hessian[row, 1], held.hessian)
    np.testing.assert_allclose(found.within_places[0][1], scatter)
    np.testing.assert_array_equal(found.rows.hessian[1, 0], sums.rows.hessian[1, 0])
