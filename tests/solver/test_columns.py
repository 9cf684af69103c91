"""Columns beside the pose: the scan distortion, what a twist does to pixels, the fit of some."""

from dataclasses import replace

import numpy as np
import pytest

from calibgraph import Camera, Correspondences, MatcherErrors, Rig, simulate_correspondences
from calibgraph.model.config import Config
from calibgraph.model.geometry import adjoints, invert, to_T_lidar_camera, twist_between
from calibgraph.simulation.rigs import rig_of
from calibgraph.solver.columns import (
    ColumnFit,
    apply_twist,
    block_of,
    distortion_evidence,
    fit_columns,
    pair_jacobians,
)
from calibgraph.solver.joint import solve_joint
from factors import Columns, fields_px
from tests.conftest import KANNALA, RADTAN5, make_camera, points_in_front
from tests.draws.places import distortions_at

STEP = np.array([2e-4, 2e-3, 4e-3])  # far below the scale of the loss
SIGMAS = {"k1": 0.01, "k2": 0.1, "offset": 1.0, "elevation": 0.01}


@pytest.mark.parametrize("bend", [0, 1, 2])
def test_the_shift_is_how_a_solve_of_the_bent_cloud_differs(mixed_rig: Rig, bend: int) -> None:
    errors = MatcherErrors(noise_px=0.5, outlier_share=0.05)
    table = simulate_correspondences(mixed_rig, frames=4, matches=200, errors=errors, seed=0)
    config = Config(learnt_weights=False, prior_weight=0.0, relative_prior_weight=0.0)
    solution = solve_joint(mixed_rig, table, config)
    inliers, points = solution.inliers, table.points_lidar_m
    bent = replace(table, points_lidar_m=points + STEP[bend] * distortions_at(points)[bend])
    moved = solve_joint(mixed_rig, bent, config).T_camera_lidar
    for name, T in solution.T_camera_lidar.items():
        pose = to_T_lidar_camera(T)
        block, scale = inliers.blocks[name], solution.scales[name]
        shifts = distortion_evidence(
            block, scale, T, np.zeros((6, 6)), places=[np.arange(4)]
        ).jacobian
        found = pose.localCoordinates(to_T_lidar_camera(moved[name]))
        expected, unit = shifts[:, bend] * STEP[bend], np.repeat([1e-3, 0.01], 3)
        # Weights of the loss and the gate, which are left out of it, are worth up to 15 %.
        off = np.linalg.norm((found - expected) / unit)
        assert off < 0.2 * np.linalg.norm(expected / unit)


def test_what_the_cameras_show_of_the_bends_moves_them_back() -> None:
    """Motion of 0.1 m, of a table that states 0.15 m and nothing else."""
    rig = rig_of("omni")
    table = simulate_correspondences(rig, frames=6, matches=400, seed=0)
    points = table.points_lidar_m
    stated = {**table.metadata, "scan_motion_m": 0.15}
    bent = replace(table, points_lidar_m=points + 0.1 * distortions_at(points)[2], metadata=stated)
    config = Config(learnt_weights=False, prior_weight=0.0, relative_prior_weight=0.0)
    without = solve_joint(rig, replace(bent, metadata=table.metadata), config)
    solution = solve_joint(rig, bent, config)
    values, covariance = solution.errors.distortion
    unit = bent.findings.bend_sigmas[2]
    assert abs(unit * values[2] - 0.1) < 3 * unit * np.sqrt(covariance[2, 2]) < 0.06
    mounts = solution.errors.of_mount.T_camera_lidar
    for name, T in rig.T_camera_lidar.items():
        before, after = (
            np.abs(twist_between(of[name], T)).max() for of in (without.T_camera_lidar, mounts)
        )
        assert after < 0.5 * before
        # The alignment is where the displaced cloud meets the images.
        step = twist_between(solution.T_camera_lidar[name], without.T_camera_lidar[name])
        assert np.abs(step).max() < 0.1 * before


def test_a_pair_follows_the_bends_by_one_motion_of_the_cloud(mixed_rig: Rig) -> None:
    """The mean of what its cameras see, so that their relative pose stays; a silent one with it."""
    T = np.stack([invert(camera.T_camera_lidar) for camera in mixed_rig.cameras.values()])
    shifts = np.random.default_rng(0).standard_normal((3, 6, 2))
    seen, to_cloud = np.array([True, True, False]), adjoints(T)
    found = to_cloud @ pair_jacobians(shifts, seen, T, [(0, 1)])
    both = (to_cloud[0] @ shifts[0] + to_cloud[1] @ shifts[1]) / 2
    np.testing.assert_allclose(found, [both, both, np.zeros((6, 2))], rtol=0, atol=1e-12)
    found = to_cloud @ pair_jacobians(shifts, seen, T, [(0, 1), (1, 2)])
    alone = to_cloud[1] @ shifts[1]
    np.testing.assert_allclose(found, [both, (both + alone) / 2, alone], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "camera",
    [
        make_camera((0.3, 0.1, -0.1)),
        make_camera(distortion=RADTAN5),
        make_camera(model="fisheye", distortion=KANNALA),
    ],
)
def test_the_fields_of_a_pose_are_derivatives_by_a_twist(camera: Camera) -> None:
    points = points_in_front(np.random.default_rng(0), 100)
    _, fields = see(camera, points)
    step = 1e-6
    for index in range(6):
        twist = step * np.eye(6)[index]
        plus, minus = (see(apply_twist(camera, sign * twist), points)[0] for sign in (1, -1))
        # Central differences: rounding of 1e3 px / 2e-6, and a third derivative times 1e-12.
        np.testing.assert_allclose((plus - minus) / (2 * step), fields[index].T, atol=1e-4)


def see(
    camera: Camera, points: np.ndarray, *lens: str, twist_per_s: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The pixels of points, and their derivatives by pose and lens."""
    return fields_px(points, camera.T_camera_lidar, columns_of(camera, *lens), twist_per_s)


def columns_of(camera: Camera, *parameters: str) -> Columns:
    return Columns(camera.lens, parameters, tuple(SIGMAS[name] for name in parameters))


def table_of(
    pixels: np.ndarray, points: np.ndarray, frames: int, **more: object
) -> Correspondences:
    frame = np.arange(len(points)) % frames
    return Correspondences.from_arrays(
        camera="front", frame=frame, pixels_px=pixels, points_lidar_m=points, **more
    )


def fit_table(
    camera: Camera, table: Correspondences, *lens: str, considered: int = 0
) -> ColumnFit | None:
    block, free = block_of(camera, table), columns_of(camera, *lens)
    return fit_columns(block, camera.T_camera_lidar, free, considered=considered)


def test_the_fit_is_exact_without_noise() -> None:
    rng = np.random.default_rng(3)
    camera, points = make_camera(), points_in_front(rng, 300)
    twist = 1e-4 * rng.standard_normal(6)
    pixels, fields = see(camera, points, "k1")
    of_pose = np.tensordot(twist, fields[:6], axes=1).T
    fit = fit_table(camera, table_of(pixels + of_pose + 0.7 * fields[6].T, points, 5), "k1")
    freed = fit.free(0)
    np.testing.assert_allclose(freed.values, [0.7], rtol=1e-4)  # the weak prior is 3e-5 of it
    np.testing.assert_allclose(freed.twist, twist, atol=1e-7)
    seen = see(apply_twist(camera, freed.twist), points)[0]
    np.testing.assert_allclose(seen, pixels + of_pose, atol=1e-3)  # second order: 1e-7 f


def moving_table(camera: Camera, of_camera: np.ndarray, count: int) -> Correspondences:
    """Matches of a LiDAR with the motion that a twist of the camera is, (6,)."""
    points = points_in_front(np.random.default_rng(4), count)
    of_lidar = np.linalg.solve(adjoints(camera.T_camera_lidar[None])[0], of_camera)
    pixels = see(camera, points)[0]
    return table_of(pixels, points, 4, twist_per_s=np.tile(of_lidar, (count, 1)))


def test_a_column_that_the_pose_compensates_is_not_observable() -> None:
    camera = make_camera()
    fit = fit_table(camera, moving_table(camera, np.eye(6)[0], 100), "offset")
    assert fit.free(0).sigmas[0] > 0.99  # as the prior of the pose: a radian


def test_compensating_twist_undoes_what_a_column_displaces() -> None:
    """A camera that waits moves by the twist, the points of its frame by the opposite."""
    camera, twist = make_camera(), np.random.default_rng(5).standard_normal(6)
    fit = fit_table(camera, moving_table(camera, twist, 200), "offset")
    np.testing.assert_allclose(fit.free(0).compensating[:, 0], twist, rtol=1e-5)


def test_a_few_rows_and_a_single_frame_have_no_fit_and_no_sigma() -> None:
    rng = np.random.default_rng(8)
    camera, points = make_camera(), points_in_front(rng, 100)
    table = table_of(see(camera, points)[0] + rng.standard_normal((100, 2)), points, 1)
    assert fit_table(camera, table.select(np.arange(20)), "k1") is None
    fit = fit_table(camera, table, "k1")
    assert fit is not None and np.isnan(fit.free(0).sigmas).all()


@pytest.mark.parametrize("outliers", [0, 90])
def test_sigmas_are_the_scatter_of_the_values(outliers: int) -> None:
    """Over 60 draws, 0.7 to 1.5 of it: four times the scatter of a standard deviation (9 %)."""
    rng = np.random.default_rng(7)
    camera, points = make_camera(), points_in_front(rng, 300)
    exact, values, sigmas = see(camera, points)[0], [], []
    for _ in range(60):
        pixels = exact + rng.standard_normal((300, 2))
        pixels[:outliers] += rng.uniform(-300, 300, (outliers, 2))
        fit = fit_table(camera, table_of(pixels, points, 30), "k1")
        values.append(fit.free(0).values[0])
        sigmas.append(fit.free(0).sigmas[0])
    assert 0.7 < np.mean(sigmas) / np.sqrt(np.mean(np.square(values))) < 1.5


def test_what_is_considered_widens_a_column_by_its_scatter() -> None:
    """Over 200 draws, within a fifth: four times the scatter of a standard deviation (5 %)."""
    rng, lens = np.random.default_rng(9), ("k1", "k2", "elevation")
    camera, points = make_camera(), points_in_front(rng, 300)
    exact, fields = see(camera, points, *lens)
    values, sigmas, alone = [], [], []
    for _ in range(200):
        shifts = np.tensordot(rng.standard_normal(2), fields[7:], axes=1).T
        table = table_of(exact + shifts + 0.1 * rng.standard_normal((300, 2)), points, 30)
        fit = fit_table(camera, table, *lens, considered=2)
        values.append(fit.free(0).values[0])
        sigmas.append(fit.free(0).sigmas[0])
        alone.append(replace(fit, considered=0).free(0).sigmas[0])
    assert np.mean(sigmas) == pytest.approx(np.std(values), rel=0.2)
    assert np.mean(alone) < 0.5 * np.mean(sigmas)
