"""Time offsets of places: a chain of stock factors, as exact with places as without."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from calibgraph import Correspondences, IncrementalCalibrator
from calibgraph.graph.variables import lens_key, seen_lens_at_key, seen_lens_key
from calibgraph.tracking.frame_order import with_place
from calibgraph.tracking.offset_walk import times_of
from tests.tracking.late_drives import (
    OFFSET,
    RATE,
    late,
    moves,
    offset_errors,
    squared_errors,
    town,
    track,
)

PLACE_FRAMES = 30  # some 20 m


def at_places(tables: list[Correspondences], loop: int = 1000) -> list[Correspondences]:
    return [with_place(t, k // PLACE_FRAMES % loop) for k, t in enumerate(tables)]


@pytest.fixture(scope="module")
def tracker() -> IncrementalCalibrator:
    """At the fourth place, at the end of an epoch."""
    truth, tables = late(town(100, 1), np.full(100, 0.005), 1)
    tracker = IncrementalCalibrator(truth, OFFSET)
    for table in at_places(tables):
        tracker.update(table)
    return tracker


def test_offsets_of_places_that_were_left_walk_to_the_present(
    tracker: IncrementalCalibrator,
) -> None:
    graph = tracker._closed.fit.linear.model.lens_graph
    factors = [graph.at(index) for index in range(graph.size())]
    chain = [one for one in factors if isinstance(one, gtsam.BetweenFactorVector)]
    assert [list(one.keys()) for one in chain] == [
        [seen_lens_at_key(place, camera), following]
        for camera in range(2)
        for place, following in (
            (0, seen_lens_at_key(1, camera)),
            (1, seen_lens_at_key(2, camera)),
            (2, seen_lens_key(camera)),
        )
    ]
    step = (1e-4 / 0.05) ** 2
    variances = [one.noiseModel().sigmas()[0] ** 2 for one in chain]
    assert variances[:3] == pytest.approx([30 * step, 30 * step, 10 * step], rel=1e-3)
    assert times_of(tracker._state) == {"0": 30, "1": 60, "2": 90, "3": 100}


def test_a_summary_of_places_has_the_marginal_of_the_chain(tracker: IncrementalCalibrator) -> None:
    """The window of the next epoch has one factor for them, the closed graph all variables."""
    state, closed = tracker._state, tracker._closed
    window, _ = closed.with_open_epoch(state, None)
    for camera in range(2):
        key = lens_key(camera)
        linear = closed.fit.linear
        optimum = linear.values.retract(linear.step)
        value, variance = optimum.atVector(key)[0], linear.covariance_of([key])[0, 0]
        assert abs(window.values.atVector(key)[0] - value) < 0.05 * variance**0.5
        assert window.covariance([key])[0, 0] == pytest.approx(variance, rel=0.02)


@pytest.mark.statistics
@pytest.mark.parametrize(("loop", "seeds"), [(1000, range(4)), (3, range(4, 8))])
def test_with_places_a_drifting_offset_is_followed(loop: int, seeds: range) -> None:
    """Along a street, and three places round and round; 0.15 ms a second."""
    squares, poses = list[float](), list[float]()
    for seed in seeds:
        offsets = 0.005 + RATE * np.arange(240)
        truth, tables = late(town(240, seed), offsets, seed)
        updates = track(truth, at_places(tables, loop))
        assert moves(updates) == []
        for frame in range(60, 240, 20):
            squares += np.square(offset_errors(updates[frame], offsets[frame])).tolist()
            poses += squared_errors(updates[frame], truth)
        assert all(one.sigma < 1.5e-3 for (one,) in updates[-1].lens.values())
    assert np.mean(squares) < 2.0  # 1 of noise, and less than 1 of the lag
    assert np.mean(poses) < 1.25
