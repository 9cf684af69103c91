"""Sums of a camera's residuals: over places, over older epochs, and of the gate."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from calibgraph import Config, Correspondences, MatcherErrors, Rig, simulate_correspondences
from calibgraph.solver.matches import CameraBlock, camera_blocks
from calibgraph.solver.preprocess import preprocess
from calibgraph.tracking.state import STRENGTHS
from calibgraph.tracking.sums import MOST_PLACES, PlaceSums, Sums

Array = np.ndarray


def part(name: str, seed: int, frames: int = 3) -> tuple[str, Sums]:
    """Sums of two cameras at a place."""
    rng = np.random.default_rng(seed)
    roots, scores = rng.standard_normal((2, 6, 6)), rng.standard_normal((frames, 2, 6))
    hessian = roots @ roots.swapaxes(1, 2)
    return name, Sums.zeros(2).change(
        hessian=hessian,
        gradient=rng.standard_normal((2, 6)),
        reweighted=hessian,
        score=scores.sum(axis=0),
        scatter=np.einsum("fni,fnj->nij", scores, scores),
        frames=np.full(2, float(frames)),
        matches=np.full(2, 100.0 * frames),
    )


def sums_of(*parts: tuple[str, Sums]) -> PlaceSums:
    found = PlaceSums.empty(2)
    for name, one in parts:
        found = found.add([name], Sums(one.packed[None]))
    return found


def test_frames_of_several_places_are_added_to_theirs_the_last_visited_last() -> None:
    frames = [part(name, seed) for seed, name in enumerate("abac")]
    names, sums = zip(*frames, strict=True)
    found = PlaceSums.empty(2).add([names[0]], Sums(np.array([sums[0].packed])))
    found = found.add(names[1:], Sums(np.array([one.packed for one in sums[1:]])))
    assert found.names[1:] == ("b", "a", "c")
    np.testing.assert_allclose(found.rows.packed[2], sums[0].packed + sums[2].packed)


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
    walks = Sums(np.tile(epoch.packed, (len(STRENGTHS), 1)))
    variance = np.linspace(0.1, 0.6, 6)
    after = walks.after_walk(np.outer(STRENGTHS**2, variance), np.full(len(STRENGTHS), 3.0))
    for walk, strength in enumerate(STRENGTHS):
        expected = inverse_sandwich(epoch) + strength**2 * np.diag(variance)
        np.testing.assert_allclose(inverse_sandwich(after[walk]), expected, rtol=1e-9)
        steps = [np.linalg.solve(sums.hessian, sums.gradient) for sums in (after[walk], epoch)]
        np.testing.assert_allclose(*steps)
    np.testing.assert_allclose(after.hessian[0], epoch.hessian, rtol=1e-12)  # it stands


def inverse_sandwich(sums: Sums) -> Array:
    inverse = np.linalg.inv(sums.hessian)
    return np.asarray(inverse @ sums.scatter @ inverse)


ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=0.5, outlier_share=0.1)


def matches_of(rig: Rig, table: Correspondences, name: str) -> CameraBlock:
    kept = preprocess(rig, table, Config())
    return camera_blocks(rig, kept.table, Config())[name]


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
    added = matches.gate_hessian(T, scale)
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
