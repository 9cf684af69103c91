"""Time offsets of places: a chain of stock factors, as exact with places as without."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from calibgraph import Correspondences, IncrementalCalibrator
from calibgraph.graph.lens import walk_graph
from calibgraph.graph.variables import lens_key, seen_lens_at_key, seen_lens_key
from calibgraph.tracking.frame_order import with_place
from calibgraph.tracking.offset_terms import with_shared_errors
from calibgraph.tracking.offset_walk import bounded, times_of
from calibgraph.tracking.place_sums import MOST_PLACES, PlaceSums
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


def test_a_walk_over_no_time_ties_offsets_together() -> None:
    keys = [seen_lens_at_key(0, 0), seen_lens_at_key(1, 0), seen_lens_key(0)]
    graph, values = walk_graph(0, [(keys[0], 0.0), (keys[1], 4.0)]), gtsam.Values()
    graph.add(gtsam.PriorFactorVector(keys[0], np.ones(1), gtsam.noiseModel.Unit.Create(1)))
    for key in keys:
        values.insert(key, np.zeros(1))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    marginals = gtsam.Marginals(graph, found)
    assert [found.atVector(key)[0] for key in keys] == pytest.approx([1.0] * 3)
    variances = [marginals.marginalCovariance(key)[0, 0] for key in keys]
    assert variances == pytest.approx([1.0, 1.0, 5.0], rel=1e-6)


def test_shared_errors_leave_the_pose_and_widen_the_offset() -> None:
    """Poses of places that are 3 times as uncertain again: so is the offset, given any pose."""
    A = 1e3 * np.random.default_rng(0).normal(size=(7, 20))
    hessian, least = A @ A.T, 0.5
    of_poses = 3 * least * np.linalg.inv(hessian[:6, :6])
    found = with_shared_errors(hessian[None], of_poses[None], least)[0]
    assert np.array_equal(found[:6], hessian[:6])
    alone, before = (1 / np.linalg.inv(one)[6, 6] for one in (found, hessian))
    assert alone == pytest.approx(before / 4, rel=1e-3)


def test_the_older_places_have_the_offset_of_the_last_of_them(
    tracker: IncrementalCalibrator,
) -> None:
    state = tracker._state
    part = state.epochs[-2].sums
    sums, times = PlaceSums.empty(2, 7), {}
    for place in range(MOST_PLACES + 2):
        sums, times[str(place)] = sums.add({str(place): part}), 10 * (place + 1)
    found, left = bounded(state, sums, times)
    assert found.names == (sums.names[0], *map(str, range(2, MOST_PLACES + 2)))
    assert left == {found.names[0]: 20} | {str(p): 10 * (p + 1) for p in range(2, MOST_PLACES + 2)}
    both, one = (1 / np.linalg.inv(s[0].hessian)[6, 6] for s in (found.rows[0], part))
    assert one < both < 2 * one  # less than twice: the first has walked


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
