from __future__ import annotations

import numpy as np
import pytest

from calibgraph import Rig, perturb
from calibgraph.model.geometry import pose_difference, twist_between
from calibgraph.service.pick.estimate import estimate_from_pairs
from calibgraph.service.pick.session import Pair
from calibgraph.simulation.rigs import rig_of
from tests.conftest import stereo_relative_pose
from tests.service.pick.builders import draw_pairs, pair_of, project

CAMERA = "image_2"


@pytest.fixture
def truth() -> Rig:
    return rig_of("kitti")


@pytest.fixture
def guess(truth: Rig) -> Rig:
    return perturb(truth, rotation_deg=20, translation_m=1, seed=3)


def errors(found: Rig, truth: Rig) -> dict[str, tuple[float, float]]:
    T = truth.T_camera_lidar
    return {
        name: pose_difference(T_found, T[name]) for name, T_found in found.T_camera_lidar.items()
    }


def test_four_exact_pairs_of_each_camera_give_the_truth_whatever_the_guess(
    truth: Rig, guess: Rig
) -> None:
    rng = np.random.default_rng(1)
    pairs = [pair for name in truth.cameras for pair in draw_pairs(truth, name, 4, rng)]
    found = estimate_from_pairs(guess, pairs)
    assert found.solve is not None
    for degrees, centimetres in errors(found.solve.rig, truth).values():
        assert degrees < 1e-4  # LM stops at a relative change of the cost of 1e-10
        assert centimetres < 1e-2


@pytest.mark.parametrize("lens", ["fisheye", "walkley"])
def test_lenses_with_distortion_are_solved_as_recorded(lens: str) -> None:
    rig = rig_of("walkley") if lens == "walkley" else rig_of("fisheye")
    name = next(iter(rig.cameras))
    T = rig.T_camera_lidar[name]
    rng = np.random.default_rng(2)
    rays = np.column_stack([rng.uniform(-0.5, 0.5, (8, 2)), np.ones(8)])
    points = (rays * rng.uniform(4, 20, (8, 1)) - T[:3, 3]) @ T[:3, :3]
    pixels = project(rig, name, points)
    pairs = [pair_of(name, u, p) for u, p in zip(pixels, points, strict=True)]
    found = estimate_from_pairs(perturb(rig, rotation_deg=10, translation_m=0.5, seed=1), pairs)
    assert found.solve is not None
    degrees, centimetres = pose_difference(found.solve.rig.T_camera_lidar[name], T)
    assert degrees < 1e-4
    assert centimetres < 1e-2


def test_all_solvers_agree_on_exact_pairs_and_part_over_a_wrong_one(truth: Rig) -> None:
    pairs = draw_pairs(truth, CAMERA, 12, np.random.default_rng(4))
    agreed = estimate_from_pairs(truth, pairs).cameras[CAMERA]
    assert {pose.solver for pose in agreed.solvers} == {
        "SQPnP", "EPnP", "P3P + RANSAC", "MAGSAC", "iterative"
    }  # fmt: skip
    spoilt = estimate_from_pairs(truth, with_wrong_pixel(pairs, 5)).cameras[CAMERA]
    assert agreed.spread is not None
    assert spoilt.spread is not None
    assert agreed.spread[0] < 0.01
    assert spoilt.spread[0] > 10 * agreed.spread[0]


def with_wrong_pixel(pairs: list[Pair], place: int, off_px: float = 30.0) -> list[Pair]:
    u, v = pairs[place].pixel_px
    wrong = pairs[place].model_copy(update={"pixel_px": (u + off_px, v)})
    return [*pairs[:place], wrong, *pairs[place + 1 :]]


def test_the_wrong_pair_is_named_and_no_other(truth: Rig) -> None:
    pairs = draw_pairs(truth, CAMERA, 12, np.random.default_rng(5), noise_px=1.0)
    found = estimate_from_pairs(truth, with_wrong_pixel(pairs, 7)).cameras[CAMERA]
    assert [i for i, one in enumerate(found.influences) if one.suspicious] == [7]
    assert any(warning.startswith("pair 8 disagrees") for warning in found.warnings)


def test_leaving_a_pair_out_changes_what_solving_without_it_changes(truth: Rig) -> None:
    pairs = draw_pairs(truth, CAMERA, 10, np.random.default_rng(6), noise_px=1.0)
    found = estimate_from_pairs(truth, pairs)
    for place, one in enumerate(found.cameras[CAMERA].influences):
        left = [
            p if i != place else p.model_copy(update={"used": False}) for i, p in enumerate(pairs)
        ]
        without = estimate_from_pairs(truth, left)
        assert found.solve is not None
        assert without.solve is not None
        xi = twist_between(
            without.solve.rig.T_camera_lidar[CAMERA], found.solve.rig.T_camera_lidar[CAMERA]
        )
        # One Gauss-Newton step: what is left is of the second order in the change.
        assert one.moves_deg == pytest.approx(
            np.degrees(np.linalg.norm(xi[:3])), rel=0.05, abs=1e-4
        )
        assert one.moves_cm == pytest.approx(100 * np.linalg.norm(xi[3:]), rel=0.05, abs=1e-2)


def test_a_relative_pose_ties_the_cameras_and_narrows_the_error_bar(truth: Rig) -> None:
    rng = np.random.default_rng(7)
    pairs = [
        *draw_pairs(truth, "image_2", 12, rng, noise_px=1.0),
        *draw_pairs(truth, "image_3", 4, rng, noise_px=1.0),
    ]
    tied = truth.model_copy(
        update={"relative_poses": (stereo_relative_pose(truth, "image_2", "image_3"),)}
    )
    alone, together = (estimate_from_pairs(rig, pairs).solve for rig in (truth, tied))
    assert alone is not None
    assert together is not None
    sigmas = [np.sqrt(np.diag(solve.covariance_of("image_3"))) for solve in (alone, together)]
    assert (sigmas[1] < 0.8 * sigmas[0]).all()


def test_too_few_pairs_are_said(truth: Rig) -> None:
    pairs = draw_pairs(truth, CAMERA, 3, np.random.default_rng(8))
    found = estimate_from_pairs(truth, pairs)
    assert found.solve is None
    assert found.cameras[CAMERA].warnings == ("too few pairs: 1 more is needed",)


def on_plane(truth: Rig, count: int, *, line: bool) -> list[Pair]:
    rng = np.random.default_rng(9)
    across = rng.uniform(-4, 4, count)
    height = 0.1 * across if line else rng.uniform(-1.5, 1, count)
    points = np.column_stack([np.full(count, 12.0), across, height])
    pixels = project(truth, CAMERA, points)
    return [pair_of(CAMERA, u, p) for u, p in zip(pixels, points, strict=True)]


def test_points_on_one_line_are_said_and_not_solved(truth: Rig) -> None:
    found = estimate_from_pairs(truth, on_plane(truth, 8, line=True))
    assert found.solve is None
    assert "on one line" in found.cameras[CAMERA].warnings[0]


def test_points_in_one_plane_are_said_and_solved_by_ippe_too(truth: Rig) -> None:
    found = estimate_from_pairs(truth, on_plane(truth, 8, line=False))
    assert "in one plane" in found.cameras[CAMERA].warnings[0]
    assert "IPPE" in {pose.solver for pose in found.cameras[CAMERA].solvers}
    assert found.solve is not None
    assert errors(found.solve.rig, truth)[CAMERA][0] < 1e-3


@pytest.mark.statistics
def test_sigmas_are_right_over_30_pickers_with_1_px_of_noise(truth: Rig) -> None:
    """Of 12 pairs over 2 frames, the same points for all: z-scores of xi against the truth."""
    exact = draw_pairs(truth, CAMERA, 12, np.random.default_rng(10))
    rng, twists, squares, covariances = np.random.default_rng(11), [], [], []
    for _ in range(30):
        found = estimate_from_pairs(truth, [noisy(pair, rng) for pair in exact])
        assert found.solve is not None
        covariance = found.solve.covariance_of(CAMERA)
        assert covariance is not None
        xi = twist_between(found.solve.rig.T_camera_lidar[CAMERA], truth.T_camera_lidar[CAMERA])
        twists.append(xi)
        covariances.append(covariance)
        squares.append(xi @ np.linalg.solve(covariance, xi))
    # The scatter of 30 has a relative standard deviation of 1 / sqrt(58) = 0.13 per axis: 3 of it.
    scatter = np.sqrt(np.mean(np.square(twists), axis=0))
    stated = np.sqrt(np.mean([np.diag(c) for c in covariances], axis=0))
    assert (np.abs(scatter / stated - 1) < 0.4).all()
    # The mean of 30 chi-squares of 6 has the standard deviation sqrt(12 / 30) = 0.63, and F-like
    # tails by the estimated scale (26 residuals) add 26 / 24: 6.5 +- 3 * 0.75.
    assert 4.2 < np.mean(squares) < 8.8
    degrees = np.degrees(np.linalg.norm(np.array(twists)[:, :3], axis=1))
    centimetres = 100 * np.linalg.norm(np.array(twists)[:, 3:], axis=1)
    print(f"scatter / stated {scatter / stated}, chi2 {np.mean(squares):.2f}")
    print(f"medians {np.median(degrees):.3f} deg {np.median(centimetres):.2f} cm")


def noisy(pair: Pair, rng: np.random.Generator) -> Pair:
    u, v = np.array(pair.pixel_px) + rng.standard_normal(2)
    return pair.model_copy(update={"pixel_px": (float(u), float(v))})
