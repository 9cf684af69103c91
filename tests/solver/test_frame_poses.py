"""Poses of many frames at once are those of each frame by itself."""

from __future__ import annotations

import numpy as np

from calibgraph import MatcherErrors, Rig, perturb, simulate_correspondences
from calibgraph.graph.objective import projection_graph
from calibgraph.solver.frame_poses import fit_frames, move_damped
from calibgraph.solver.optimizer import optimize
from factors import ProjectionBlock, to_runs


def test_every_frame_ends_where_levenberg_marquardt_of_gtsam_does(mixed_rig: Rig) -> None:
    errors = MatcherErrors(noise_px=1.0, outlier_share=0.2)
    table = simulate_correspondences(mixed_rig, frames=5, matches=200, errors=errors)
    guess = perturb(mixed_rig, rotation_deg=0.5, translation_m=0.05)
    for name, camera in guess.cameras.items():
        rows = table.of_camera(name)
        block = ProjectionBlock(camera.lens, rows.points_lidar_m, rows.pixels_px)
        runs = to_runs(np.append(np.unique(rows.frame, return_index=True)[1], len(rows)))
        fit = fit_frames(block, runs, np.tile(camera.T_camera_lidar, (len(runs), 1, 1)))
        assert fit.converged.all()
        for run, T in zip(runs, fit.T_camera_lidar, strict=True):
            alone = projection_graph(["one"], {"one": block.select(np.arange(*run))})
            found = optimize(alone, ["one"], {"one": camera.T_camera_lidar}).T_camera_lidar["one"]
            # Both stop where the cost changes by 1e-10 of itself: 1e-5 of a standard deviation,
            # which is 1e-3 rad and 1e-2 m for 200 matches.
            np.testing.assert_allclose(T, found, atol=1e-7)


def test_a_free_direction_gets_no_step() -> None:
    sums = np.zeros((1, 28))
    sums[0, :21] = np.diag([1.0, 2, 0, 4, 5, 6])[np.triu_indices(6)]
    sums[0, 21:27] = 1.0, 2, 0, 4, 5, 6
    _, step = move_damped(sums, np.eye(4)[None], damping=0.0)
    np.testing.assert_allclose(step, [[-1, -1, 0, -1, -1, -1]])


def test_frames_that_leave_directions_free_do_not_become_singular(pair: Rig) -> None:
    """Matches in one point: two rows of six, and a damping that falls with every good step."""
    camera, frames, matches = pair.cameras["left"], 2000, 5
    rng = np.random.default_rng(0)
    seen = simulate_correspondences(pair, frames=1, matches=frames).of_camera("left")
    seen = seen.select(rng.integers(len(seen), size=frames))
    points = np.repeat(seen.points_lidar_m, matches, axis=0)
    pixels = np.repeat(seen.pixels_px, matches, axis=0) + rng.normal(size=(len(points), 2))
    block = ProjectionBlock(camera.lens, points, pixels)
    runs = to_runs(np.arange(0, len(points) + 1, matches))
    fit = fit_frames(block, runs, np.tile(camera.T_camera_lidar, (frames, 1, 1)))
    assert fit.converged.all()
    # The last step changes the cost, of 5 matches of 1 px, by 1e-10 of itself: what is left to the
    # minimum is of that size.
    sums = block.run_sums(fit.T_camera_lidar, runs)
    to_minimum = np.linalg.pinv(sums.hessian, rcond=1e-9, hermitian=True)
    left = np.einsum("fi,fij,fj->f", sums.gradient, to_minimum, sums.gradient)
    assert (left <= 1e-8 * sums.cost).all()
