"""Perturbed guesses: exactly as far as asked for, or uniform in a box."""

from __future__ import annotations

import numpy as np
import pytest

from calibgraph import (
    Rig,
    perturb,
)
from calibgraph.model.geometry import angle_deg


@pytest.mark.parametrize("seed", range(5))
def test_perturb_displaces_by_exactly_what_it_says(pair: Rig, seed: int) -> None:
    moved = perturb(pair, rotation_deg=20, translation_m=1.5, seed=seed)
    deltas = [moved.T_camera_lidar[n] @ np.linalg.inv(T) for n, T in pair.T_camera_lidar.items()]
    for delta in deltas:
        assert angle_deg(delta[:3, :3]) == pytest.approx(20, abs=1e-9)
        assert np.linalg.norm(delta[:3, 3]) == pytest.approx(1.5, abs=1e-12)
    assert np.abs(deltas[0] - deltas[1]).max() > 0.1  # independent per camera


def test_perturb_uniform_stays_in_its_box(pair: Rig) -> None:
    shifts = []
    for seed in range(100):
        moved = perturb(pair, rotation_deg=20, translation_m=1.5, seed=seed, uniform=True)
        delta = moved.T_camera_lidar["left"] @ np.linalg.inv(pair.T_camera_lidar["left"])
        shifts.append(delta[:3, 3])
    assert np.abs(shifts).max() <= 1.5
    # Uniform on +-1.5: a standard deviation of 1.5 / sqrt(3), known from 300 draws to 4 %.
    assert np.std(shifts) == pytest.approx(1.5 / np.sqrt(3), rel=0.15)
