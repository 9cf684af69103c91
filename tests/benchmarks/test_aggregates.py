from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.paper.aggregates import aggregate, half_sample_mode
from tests.solver.test_stage1 import poses


def test_median_and_mode_ignore_what_the_mean_does_not() -> None:
    rng = np.random.default_rng(0)
    scattered = poses(rng, 100, 0.01)
    scattered[:30] = poses(rng, 30, 0.01)
    scattered[:30, :3, 3] += [5, 0, 0]
    scattered[:30, :3, :3] @= Rotation.from_rotvec([0, 0.5, 0]).as_matrix()
    for how, near in (("median", 0.01), ("mode", 0.02)):
        T = aggregate(scattered, how)
        assert abs(T[0, 3] - 1) < near
        assert Rotation.from_matrix(T[:3, :3]).magnitude() < 2 * near
    mean = aggregate(scattered, "mean")
    assert mean[0, 3] == pytest.approx(1 + 5 * 0.3, abs=0.01)
    assert Rotation.from_matrix(mean[:3, :3]).magnitude() == pytest.approx(0.15, abs=0.02)


def test_the_half_sample_mode_is_where_samples_are_densest() -> None:
    rng = np.random.default_rng(0)
    samples = np.concatenate([rng.normal(3, 0.01, 60), rng.uniform(0, 10, 40)])
    assert half_sample_mode(samples) == pytest.approx(3, abs=0.02)
    assert half_sample_mode([7.0]) == 7.0
