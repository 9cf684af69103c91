"""One problem, and the implementations of its solve that are compared: see ``speed.solve``."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.paper.baselines import minimize_trf, prior_rows
from calibgraph import (
    Camera,
    Correspondences,
    MatcherErrors,
    Rig,
    perturb,
    preset,
    simulate_correspondences,
)
from calibgraph.graph.objective import objective_graph, pose_key
from calibgraph.model.geometry import invert, to_T_camera_lidar
from calibgraph.simulation.rigs import rig_of
from calibgraph.solver.camera_block import camera_blocks
from calibgraph.solver.objective import Objective
from calibgraph.solver.optimizer import to_values
from factors import projection_factor

Array = NDArray[np.float64]
Transforms = dict[str, Array]
"""Per camera, (4, 4) T_camera_lidar."""

CONFIG = preset("kitti").changed(stage1="rig")
ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=0.5, outlier_share=0.15)
SCALE_PX, GATE_PX = 4.0, 3.0  # the preset's
MATCHES = 1000


@dataclass(frozen=True, eq=False)
class Problem:
    """A table, the start, and the objective evaluated directly.

    Attributes:
        rig: lenses and the start, which is also T_hat.
        table: all correspondences.
        rows: per camera, those that the cost sums over.
    """

    rig: Rig
    table: Correspondences
    rows: dict[str, Correspondences]

    @staticmethod
    def draw(frames: int, cameras: int, matches: int = MATCHES) -> Problem:
        """A stereo pair, or a ring of cameras; the start is 0.5 deg and 5 cm off."""
        rig = rig_of("kitti") if cameras == 2 else ring(cameras)
        table = simulate_correspondences(rig, frames=frames, matches=matches, errors=ERRORS)
        guess = perturb(rig, rotation_deg=0.5, translation_m=0.05)
        return Problem(guess, table, {name: table.of_camera(name) for name in rig.cameras})

    @property
    def T_hat(self) -> Transforms:
        """The start, to which the priors pull."""
        return self.rig.T_camera_lidar

    def without_outliers(self, T: Transforms) -> Problem:
        """The problem without the correspondences beyond the gate at some extrinsics."""
        inside = {
            name: rows.select(np.linalg.norm(self.residuals(name, T[name]), axis=1) <= GATE_PX)
            for name, rows in self.rows.items()
        }
        return replace(self, rows=inside)

    def residuals(self, name: str, T: Array) -> Array:
        """(n, 2) residuals of a camera, as the paper's Python would compute them."""
        lens, rows = self.rig.cameras[name].intrinsics_px, self.rows[name]
        p = rows.points_lidar_m @ T[:3, :3].T + T[:3, 3]
        u, v = lens.fx * p[:, 0] / p[:, 2] + lens.cx, lens.fy * p[:, 1] / p[:, 2] + lens.cy
        return np.stack([u, v], 1) - rows.pixels_px

    def cost(self, T: Transforms) -> float:
        """The paper's objective, evaluated directly."""
        total = float(np.sum(self.prior_rows(T) ** 2))
        for name in self.rows:
            s = np.sum(self.residuals(name, T[name]) ** 2, axis=1)
            total += float(SCALE_PX**2 * np.log1p(s / SCALE_PX**2).sum())
        return total

    def prior_rows(self, T: Transforms) -> Array:
        """Both priors as residuals: their squares are the two terms."""
        return prior_rows(T, self.T_hat, CONFIG)


def ring(count: int) -> Rig:
    """Cameras of the stereo pair's kind in a circle around the LiDAR, 40 cm from it."""
    kind = next(iter(rig_of("kitti").cameras.values()))
    cameras: dict[str, Camera] = {}
    for k in range(count):
        T_lidar_camera = np.eye(4)
        turn = Rotation.from_euler("z", 2 * np.pi * k / count).as_matrix()
        T_lidar_camera[:3, :3] = turn @ np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
        T_lidar_camera[:3, 3] = turn @ [0.4, 0.0, -0.2]
        cameras[f"camera_{k:02}"] = kind.moved_to(invert(T_lidar_camera))
    return Rig(cameras=cameras)


@dataclass(frozen=True)
class Passes:
    """What an implementation found.

    Attributes:
        first: T_camera_lidar after the first pass.
        second: after the second; None if only the first was run.
    """

    first: Transforms
    second: Transforms | None = None


def solve_ours(problem: Problem) -> Passes:
    """Both passes of calibgraph; the time includes building the graph."""
    objective = _objective(problem)
    rough, scales = objective.minimize_with_scale(problem.T_hat)
    inliers = objective.without_outliers(rough, scales)
    return Passes(rough, inliers.minimize(rough, scales).T_camera_lidar)


def solve_ours_once(problem: Problem) -> Passes:
    """The first pass alone, to compare with implementations that do no more."""
    return Passes(_objective(problem).minimize_with_scale(problem.T_hat)[0])


def _objective(problem: Problem) -> Objective:
    blocks = camera_blocks(problem.rig, problem.table, CONFIG)
    return Objective(problem.rig, blocks, problem.T_hat, CONFIG, "full")


def solve_trf(problem: Problem, inliers: Problem) -> Passes:
    """The paper's solver, both passes; what the second drops is given."""
    first = _one_trf(problem, problem.T_hat)
    return Passes(first, _one_trf(inliers, first))


def solve_trf_once(problem: Problem) -> Passes:
    """The first pass of the paper's solver."""
    return Passes(_one_trf(problem, problem.T_hat))


def _one_trf(problem: Problem, start: Transforms) -> Transforms:
    """One pass of TRF, as the library's comparison with the paper runs it."""

    def residuals(T: Transforms) -> Array:
        return np.concatenate([problem.residuals(name, T[name]) for name in problem.rows])

    return minimize_trf(residuals, problem.prior_rows, start, scale_px=SCALE_PX)


def solve_gtsam_cpp(problem: Problem) -> Passes:
    """One stock C++ projection factor per correspondence, its landmark held fixed."""
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(SCALE_PX)
    noise = gtsam.noiseModel.Robust.Create(cauchy, gtsam.noiseModel.Unit.Create(2))
    graph, values = _start(problem)
    landmark = 0
    for name, rows in problem.rows.items():
        key, lens = pose_key(list(problem.rows), name), problem.rig.cameras[name].intrinsics_px
        calibration = gtsam.Cal3_S2(lens.fx, lens.fy, 0.0, lens.cx, lens.cy)
        for point, pixel in zip(rows.points_lidar_m, rows.pixels_px, strict=True):
            graph.add(
                gtsam.GenericProjectionFactorCal3_S2(pixel, noise, key, landmark, calibration)
            )
            graph.add(gtsam.NonlinearEqualityPoint3(landmark, point))
            values.insert(landmark, point)
            landmark += 1
    return _first_pass(problem, graph, values)


def solve_gtsam_python(problem: Problem) -> Passes:
    """One custom Python factor per correspondence."""
    graph, values = _start(problem)
    for name, rows in problem.rows.items():
        key, lens = pose_key(list(problem.rows), name), problem.rig.cameras[name].lens
        for point, pixel in zip(rows.points_lidar_m, rows.pixels_px, strict=True):
            graph.add(projection_factor(key, lens, point, pixel, scale=SCALE_PX))
    return _first_pass(problem, graph, values)


def _start(problem: Problem) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The priors, and the start."""
    priors = objective_graph(problem.rig, {}, problem.T_hat, CONFIG, terms="full")
    return priors, to_values(list(problem.rows), problem.T_hat)


def _first_pass(
    problem: Problem, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values
) -> Passes:
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    keys = {name: pose_key(list(problem.rows), name) for name in problem.rows}
    return Passes({name: to_T_camera_lidar(found.atPose3(key)) for name, key in keys.items()})
