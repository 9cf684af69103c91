"""The pose factors mean what the paper's formulas say, evaluated directly."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam import Pose3

from factors import (
    camera_prior_factor,
    pose_sigmas,
    relative_pose_factor,
    relative_prior_factor,
)

SIZES = [1e-7, 0.01, 0.5, 1.0]


def random_pose(rng: np.random.Generator, size: float = 1.0) -> Pose3:
    return Pose3.Expmap(np.concatenate([rng.standard_normal(3), 3 * rng.standard_normal(3)]) * size)


def values(*transforms: Pose3) -> gtsam.Values:
    """Values 0, 1, ...: the inverses of the given T_camera_lidar."""
    result = gtsam.Values()
    for key, T in enumerate(transforms):
        result.insert(key, T.inverse())
    return result


@pytest.mark.parametrize("size", SIZES)
def test_camera_prior_is_the_papers_formula(size: float) -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        T_hat = random_pose(rng)
        T = T_hat.compose(random_pose(rng, 0.3 * size))
        weight = rng.uniform(0.5, 10)
        paper = weight * np.sum(Pose3.Logmap(T_hat.inverse().compose(T)) ** 2)
        factor = camera_prior_factor(0, T_hat.matrix(), weight=weight)
        assert 2 * factor.error(values(T)) == pytest.approx(paper, rel=1e-7)


@pytest.mark.parametrize("size", SIZES)
def test_relative_prior_is_the_papers_formula(size: float) -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        T_hat_1, T_hat_2 = random_pose(rng), random_pose(rng)
        T_1 = T_hat_1.compose(random_pose(rng, 0.2 * size))
        T_2 = T_hat_2.compose(random_pose(rng, 0.2 * size))
        weight = rng.uniform(0.5, 10)
        T_hat_12 = T_hat_2.compose(T_hat_1.inverse())
        difference = T_hat_12.inverse().compose(T_2).compose(T_1.inverse())
        paper = weight * np.sum(Pose3.Logmap(difference) ** 2)
        factor = relative_prior_factor(0, 1, T_hat_12.matrix(), weight=weight)
        assert 2 * factor.error(values(T_1, T_2)) == pytest.approx(paper, rel=1e-7)


def test_relative_pose_is_exact_at_the_truth_and_costs_one_at_one_sigma() -> None:
    rng = np.random.default_rng(3)
    T_a, T_b = random_pose(rng), random_pose(rng)
    T_a_b = T_a.compose(T_b.inverse())
    for axis, sigma in enumerate([0.01] * 3 + [0.002] * 3):
        off = T_a_b.compose(Pose3.Expmap(sigma * np.eye(6)[axis]))
        factor = relative_pose_factor(
            0, 1, off.matrix(), rotation_sigma_rad=0.01, translation_sigma_m=0.002
        )
        assert 2 * factor.error(values(T_a, T_b)) == pytest.approx(1.0, rel=1e-6)
    exact = relative_pose_factor(
        0, 1, T_a_b.matrix(), rotation_sigma_rad=0.01, translation_sigma_m=0.002
    )
    assert exact.error(values(T_a, T_b)) < 1e-20


def test_sigmas_are_rotation_first() -> None:
    assert pose_sigmas(rotation_rad=1.0, translation_m=2.0).tolist() == [1, 1, 1, 2, 2, 2]
