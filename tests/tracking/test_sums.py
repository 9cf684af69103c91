"""Sums of a camera's residuals: over places, over older epochs, and of the gate."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from calibgraph import Config, Correspondences, MatcherErrors, Rig, simulate_correspondences
from calibgraph.solver.matches import BlockResiduals, CameraBlock, camera_blocks
from calibgraph.solver.preprocess import preprocess
from calibgraph.tracking.epoch_summary import STRENGTHS, EpochSummary
from calibgraph.tracking.noise import ResidualHistogram
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


def test_the_walk_adds_exactly_its_variance_to_the_covariance() -> None:
    """H'^-1 B' H'^-1 = H^-1 B H^-1 + Q, whatever the gain."""
    rng = np.random.default_rng(0)
    A, C = rng.standard_normal((2, 6, 6))
    epoch = Sums.zeros().change(
        hessian=A @ A.T + np.eye(6),
        gradient=rng.standard_normal(6),
        scatter=C @ C.T,
        frames=np.array(10.0),
    )
    memory = EpochSummary.empty().add(epoch, Sums.zeros())
    variance = np.linspace(0.1, 0.6, 6)
    after = memory.propagate(np.outer(STRENGTHS**2, variance), overconfidence=3.0)
    for walk, strength in enumerate(STRENGTHS):
        expected = inverse_sandwich(memory, walk) + strength**2 * np.diag(variance)
        np.testing.assert_allclose(inverse_sandwich(after, walk), expected, rtol=1e-9)
    np.testing.assert_array_equal(after.walks.hessian[0], memory.walks.hessian[0])  # it stands
    for walk in range(len(STRENGTHS)):
        np.testing.assert_allclose(after.walks.step(walk), memory.walks.step(walk))


def inverse_sandwich(memory: EpochSummary, walk: int) -> Array:
    inverse = np.linalg.inv(memory.walks.hessian[walk])
    return np.asarray(inverse @ memory.walks.scatter[walk] @ inverse)


def test_a_walk_does_not_magnify_sums_of_a_hessian_that_is_not_definite() -> None:
    """Frames far from the estimate give one: the gain has a pole at -k / Q."""
    variance, weights = np.full(6, 0.5), np.diag([3.0, 2, 2, 2, 2, 2])
    for least in (-1.0, -5.99, -6.01, -40.0):  # k / Q is 6
        sums = Sums.zeros().change(
            hessian=np.diag([5.0, 2, 2, 2, 2, least]), reweighted=weights, gradient=np.ones(6)
        )
        after, kept = sums.after_walk(variance, 3.0)
        assert 0.5 < kept < 1 and np.linalg.eigvalsh(after.hessian)[0] > 0
        assert np.abs(after.gradient).max() < 1
        standing, _ = sums.after_walk(np.zeros(6), 3.0)
        np.testing.assert_array_equal(standing.packed, sums.packed)


ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=0.5, outlier_share=0.1)


def matches_of(rig: Rig, table: Correspondences, name: str) -> CameraBlock:
    kept = preprocess(rig, table, Config())
    return camera_blocks(rig, kept.table, Config())[name]


def test_the_histogram_finds_the_scale_of_all_frames(pair: Rig) -> None:
    """Its bins are 1 % wide and values within them are taken as even: 0.3 % is a third of one."""
    table = simulate_correspondences(pair, frames=40, matches=300, errors=ERRORS, seed=5)
    T = pair.T_camera_lidar["left"]
    spread = ResidualHistogram()
    for frame in range(40):
        block = matches_of(pair, table.select(table.frame == frame), "left")
        spread = spread.add(BlockResiduals.at(T, block))
    expected = matches_of(pair, table, "left").scale(T, Config())
    found = spread.scale(Config())
    assert found.sigma_px == pytest.approx(expected.sigma_px, rel=3e-3)
    assert found.gate_px == pytest.approx(expected.gate_px, rel=3e-3)


def test_the_gates_share_of_the_hessian_is_that_of_moved_gates(pair: Rig) -> None:
    """By differences: 60,000 matches, 2 % of them near the edge, so about 1 / sqrt(1200) = 3 %;

    of a band that the two take differently: within 15 %.
    """
    errors = MatcherErrors(noise_px=1.0, outlier_share=0.3)
    table = simulate_correspondences(pair, frames=60, matches=1000, errors=errors, seed=6)
    matches = matches_of(pair, table, "left")
    T = pair.T_camera_lidar["left"]
    scale = matches.scale(T, Config())
    pose = gtsam.Pose3(T).inverse()
    added = BlockResiduals.at(T, matches).gate_hessians(scale)[0]
    for axis in range(3):
        step = np.zeros(6)
        step[axis] = 4e-4  # 0.3 px, as wide as the band
        pulls = [
            matches.without_outliers(pose.retract(way * step).inverse().matrix(), scale)
            .with_scale(scale)
            .sums(pose)
            .gradient
            for way in (1, -1)
        ]
        by_differences = (pulls[0] - pulls[1])[axis] / (2 * step[axis])
        assert added[axis, axis] == pytest.approx(by_differences, rel=0.15)
