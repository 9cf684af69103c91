"""What pairs determine: the truth, an error bar that holds, the wrong pair."""

from __future__ import annotations

import numpy as np
import pytest

from calibgraph import CalibrationError, Rig, evaluate
from calibgraph.model.geometry import twist_between
from calibgraph.pick.estimate import MIN_PAIRS, estimate_from_pairs, reference_rig
from calibgraph.pick.session import Pair
from calibgraph.simulation.rigs import rig_of


def draw_pairs(
    rig: Rig, camera: str, count: int, rng: np.random.Generator, noise_px: float
) -> list[Pair]:
    """Pairs of points in view, at 4 to 30 m, in two frames in turn."""
    seen, T, found = rig.cameras[camera], rig.T_camera_lidar[camera], list[Pair]()
    while len(found) < count:
        direction = rng.normal(size=3)
        direction[2] *= 0.2
        point = direction / np.linalg.norm(direction) * np.exp(rng.uniform(np.log(4), np.log(30)))
        pixels, valid = seen.lens.project((T[:3, :3] @ point + T[:3, 3])[None])
        if not valid[0] or not seen.in_image(pixels)[0]:
            continue
        u, v = (pixels[0] + noise_px * rng.standard_normal(2)).tolist()
        x, y, z = point.tolist()
        pair = {"frame": len(found) % 2, "camera": camera}
        found.append(Pair(**pair, pixel_px=(u, v), point_lidar_m=(x, y, z)))
    return found


@pytest.mark.parametrize("name", ["kitti", "fisheye", "omni", "panorama"])
def test_exact_pairs_give_the_truth_without_a_guess(name: str) -> None:
    rig, rng = rig_of(name), np.random.default_rng(0)
    pairs = [pair for camera in rig.cameras for pair in draw_pairs(rig, camera, 16, rng, 0.0)]
    away = rig.moved_to({name: np.eye(4) for name in rig.cameras})
    found = reference_rig(estimate_from_pairs(away, pairs))
    for error in evaluate(found, rig).cameras.values():
        assert error.rotation_error_deg < 1e-4 and error.translation_error_cm < 1e-3


@pytest.mark.statistics
@pytest.mark.parametrize("count", [6, 12])
def test_the_error_bar_is_the_scatter_of_pickers(count: int) -> None:
    """Two cameras, 40 pickers: the mean of 80 NEES / 6 is known to 1 / sqrt(240), and by Student's
    law of six pairs to a few times that."""
    rig, nees = rig_of("kitti"), []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        pairs = [p for camera in rig.cameras for p in draw_pairs(rig, camera, count, rng, 1.0)]
        found = reference_rig(estimate_from_pairs(rig, pairs))
        for camera, one in found.cameras.items():
            xi = twist_between(one.T_camera_lidar, rig.T_camera_lidar[camera])
            nees.append(xi @ np.linalg.solve(np.array(one.covariance), xi) / 6)
    assert 0.6 < np.mean(nees) < 1.6


def test_a_wrong_pair_is_marked_and_a_right_one_is_not() -> None:
    rig, rng = rig_of("kitti"), np.random.default_rng(3)
    pairs = draw_pairs(rig, "image_2", 12, rng, 1.0)
    assert not any(estimate_from_pairs(rig, pairs).cameras["image_2"].wrong)
    u, v = pairs[4].pixel_px
    pairs[4] = pairs[4].model_copy(update={"pixel_px": (u + 60.0, v - 25.0)})
    wrong = estimate_from_pairs(rig, pairs).cameras["image_2"].wrong
    assert wrong[4]


def test_too_few_pairs_and_pairs_on_one_line_give_no_camera() -> None:
    rig, rng = rig_of("kitti"), np.random.default_rng(1)
    few = draw_pairs(rig, "image_2", MIN_PAIRS - 1, rng, 0.0)
    estimate = estimate_from_pairs(rig, few)
    assert estimate.cameras["image_2"].problem == "5 of 6 pairs"
    assert np.abs(estimate.cameras["image_2"].residuals_px).max() < 1e-6  # of the guess
    line = [
        few[0].model_copy(update={"point_lidar_m": (4.0 + k, 0.5, 0.1)}) for k in range(MIN_PAIRS)
    ]
    estimate = estimate_from_pairs(rig, line)
    with pytest.raises(CalibrationError, match="image_2: its points lie on one line"):
        reference_rig(estimate)
