"""Solve time: ours against the paper's own way (SciPy) and against separate GTSAM factors.

All minimize the same objective (paper, Eq. 5: Cauchy on the reprojection error, both priors) from
the same start, on simulated correspondences: 2 cameras, N frames, 1000 matches each, 15 % outliers.
The costs beside the times are all evaluated by one function. Run with ``make bench``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import gtsam
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calibgraph import Camera, Intrinsics, MatcherErrors, Rig, perturb, simulate_correspondences
from calibgraph.correspondences import Correspondences
from calibgraph.graph import (
    joined,
    optimize,
    pose_key,
    prior_graph,
    projection_graph,
    relative_prior_graph,
    values_of,
)
from factors import ProjectionBlock, projection_factor

Array = np.ndarray
Poses = dict[str, Array]

PRIOR_WEIGHT, RELATIVE_WEIGHT, SCALE_PX = 1.0, 5.0, 4.0  # the paper's, for KITTI
FX, CX, CY = 718.856, 607.19, 185.22


class Problem:
    """One problem, its start, and its objective."""

    def __init__(self, frames: int) -> None:
        self.rig = kitti_like_rig()
        errors = MatcherErrors(noise_px=1.0, frame_noise_px=0.5, outlier_share=0.15)
        table = simulate_correspondences(self.rig, frames=frames, matches=1000, errors=errors)
        self.cameras = list(self.rig.cameras)
        self.rows: dict[str, Correspondences] = {n: table.of_camera(n) for n in self.cameras}
        self.hat = perturb(self.rig, rotation_deg=0.5, translation_m=0.05).T_camera_lidar

    def cost(self, T: Poses) -> float:
        """The paper's objective, evaluated directly."""
        total = 0.0
        for name, rows in self.rows.items():
            s = np.sum(reprojection(T[name], rows) ** 2, axis=1)
            total += SCALE_PX**2 * np.log1p(s / SCALE_PX**2).sum()
        return total + float(np.sum(self.prior_rows(T) ** 2))

    def prior_rows(self, T: Poses) -> Array:
        """Both priors as residuals: their squares are the two terms."""
        hat, now = ({n: gtsam.Pose3(p) for n, p in poses.items()} for poses in (self.hat, T))
        one, two = self.cameras
        relative = hat[two].compose(hat[one].inverse())
        own = [gtsam.Pose3.Logmap(hat[n].inverse().compose(now[n])) for n in self.cameras]
        between = gtsam.Pose3.Logmap(
            relative.inverse().compose(now[two].compose(now[one].inverse()))
        )
        return np.concatenate(
            [np.sqrt(PRIOR_WEIGHT) * row for row in own] + [np.sqrt(RELATIVE_WEIGHT) * between]
        )


def kitti_like_rig() -> Rig:
    """Two cameras, 54 cm apart."""
    cameras = {}
    for name, x in (("left", 0.06), ("right", -0.48)):
        T = np.eye(4)
        T[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
        T[:3, 3] = [x, -0.08, -0.27]
        intrinsics = Intrinsics(fx=FX, fy=FX, cx=CX, cy=CY)
        cameras[name] = Camera(
            width_px=1241, height_px=376, intrinsics_px=intrinsics, T_camera_lidar=T
        )
    return Rig(cameras=cameras)


def reprojection(T: Array, rows: Correspondences) -> Array:
    """(n, 2) residuals of a pinhole, as the paper's Python would compute them."""
    p = rows.points_lidar_m @ T[:3, :3].T + T[:3, 3]
    return np.stack([FX * p[:, 0] / p[:, 2] + CX, FX * p[:, 1] / p[:, 2] + CY], 1) - rows.pixels_px


def ours(problem: Problem) -> Poses:
    """Block factors, LM; the time includes building the graph."""
    blocks = {
        n: ProjectionBlock(
            problem.rig.cameras[n].lens, r.points_lidar_m, r.pixels_px, None, "cauchy", SCALE_PX
        )
        for n, r in problem.rows.items()
    }
    graph = joined(projection_graph(problem.cameras, blocks), pose_graph(problem))
    return optimize(graph, problem.cameras, problem.hat).T_camera_lidar


def pose_graph(problem: Problem) -> gtsam.NonlinearFactorGraph:
    """Both priors, as factors."""
    return joined(
        prior_graph(problem.cameras, problem.hat, weight=PRIOR_WEIGHT),
        relative_prior_graph(
            problem.cameras, problem.hat, weight=RELATIVE_WEIGHT, pairs="spanning"
        ),
    )


def scipy_trf(problem: Problem) -> Poses:
    """The paper's way: TRF, axis-angle and translation, Cauchy, tolerances 1e-6."""
    counts = [len(rows) for rows in problem.rows.values()]

    def unpack(x: Array) -> Poses:
        poses = {}
        for name, six in zip(problem.cameras, x.reshape(-1, 6), strict=True):
            poses[name] = np.eye(4)
            poses[name][:3, :3] = Rotation.from_rotvec(six[:3]).as_matrix()
            poses[name][:3, 3] = six[3:]
        return poses

    def residuals(x: Array) -> Array:
        T = unpack(x)
        norms = [np.linalg.norm(reprojection(T[n], r), axis=1) for n, r in problem.rows.items()]
        return np.concatenate([*norms, problem.prior_rows(T)])

    def loss(z: Array) -> Array:
        """Cauchy on the correspondences, none on the priors."""
        rho = np.array([z, np.ones_like(z), np.zeros_like(z)])
        s = z[: sum(counts)] / SCALE_PX**2
        rho[:, : sum(counts)] = [
            SCALE_PX**2 * np.log1p(s), 1 / (1 + s), -1 / (SCALE_PX**2 * (1 + s) ** 2),
        ]  # fmt: skip
        return rho

    start = np.concatenate(
        [
            np.concatenate([Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3]])
            for T in problem.hat.values()
        ]
    )
    found = least_squares(
        residuals, start, method="trf", loss=loss, ftol=1e-6, xtol=1e-6, max_nfev=2000
    )
    return unpack(found.x)


def gtsam_stock(problem: Problem) -> Poses:
    """GTSAM's C++ projection factor each, its landmark held fixed."""
    calibration = gtsam.Cal3_S2(FX, FX, 0.0, CX, CY)
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(SCALE_PX)
    noise = gtsam.noiseModel.Robust.Create(cauchy, gtsam.noiseModel.Unit.Create(2))
    graph, values = pose_graph(problem), values_of(problem.cameras, problem.hat)
    landmark = 0
    for name, rows in problem.rows.items():
        key = pose_key(problem.cameras, name)
        for point, pixel in zip(rows.points_lidar_m, rows.pixels_px, strict=True):
            graph.add(
                gtsam.GenericProjectionFactorCal3_S2(pixel, noise, key, landmark, calibration)
            )
            graph.add(gtsam.NonlinearEqualityPoint3(landmark, point))
            values.insert(landmark, point)
            landmark += 1
    return _gtsam_poses(problem, graph, values)


def gtsam_python(problem: Problem) -> Poses:
    """Our plain per-correspondence factor, a Python call each."""
    graph = pose_graph(problem)
    for name, rows in problem.rows.items():
        key, lens = pose_key(problem.cameras, name), problem.rig.cameras[name].lens
        for point, pixel in zip(rows.points_lidar_m, rows.pixels_px, strict=True):
            graph.add(projection_factor(key, lens, point, pixel, scale=SCALE_PX))
    return _gtsam_poses(problem, graph, values_of(problem.cameras, problem.hat))


def _gtsam_poses(
    problem: Problem, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values
) -> Poses:
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    keys = {name: pose_key(problem.cameras, name) for name in problem.cameras}
    return {name: found.atPose3(key).inverse().matrix() for name, key in keys.items()}


def timed(run: Callable[[Problem], Poses], problem: Problem, repeats: int) -> tuple[float, Poses]:
    """Least wall time of several runs, and the poses."""
    times, poses = [], {}
    for _ in range(repeats):
        start = time.perf_counter()
        poses = run(problem)
        times.append(time.perf_counter() - start)
    return min(times), poses


def bandwidth_gb_s() -> float:
    """What one thread reads from memory: the sum of an array that fits no cache."""
    array = np.ones(30_000_000)
    array.sum()
    times = []
    for _ in range(5):
        start = time.perf_counter()
        array.sum()
        times.append(time.perf_counter() - start)
    return array.nbytes / min(times) / 1e9


def pass_ns(correspondences: int) -> float:
    """Nanoseconds per correspondence of one pass: H, b and c together."""
    rig = kitti_like_rig()
    table = simulate_correspondences(rig, frames=1, matches=100_000).of_camera("left")
    copies = correspondences // len(table)
    points, pixels = (np.tile(a, (copies, 1)) for a in (table.points_lidar_m, table.pixels_px))
    block = ProjectionBlock(rig.cameras["left"].lens, points, pixels)
    pose = values_of(["left"], rig.T_camera_lidar).atPose3(pose_key(["left"], "left"))
    block.sums(pose)
    times = []
    for _ in range(20):
        start = time.perf_counter()
        block.sums(pose)
        times.append(time.perf_counter() - start)
    return min(times) / len(block) * 1e9


def main() -> None:
    """Print one table per N, then the time of a pass."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, nargs="+", default=[10, 100])
    parser.add_argument("--python-factors-up-to", type=int, default=10, metavar="N")
    arguments = parser.parse_args()
    ours(Problem(1))  # compile
    for frames in arguments.frames:
        problem = Problem(frames)
        ways = [
            ("calibgraph, block factors", ours, 5),
            ("SciPy TRF, the paper's way", scipy_trf, 1),
        ]
        ways.append(("GTSAM, stock C++ factor each", gtsam_stock, 1))
        if frames <= arguments.python_factors_up_to:
            ways.append(("GTSAM, Python factor each", gtsam_python, 1))
        print(f"\nN = {frames} frames, {sum(map(len, problem.rows.values()))} correspondences")
        print(f"{'':30} {'seconds':>10} {'ratio':>8} {'cost':>18}")
        base = 0.0
        for name, run, repeats in ways:
            seconds, poses = timed(run, problem, repeats)
            base = base or seconds
            print(f"{name:30} {seconds:10.4f} {seconds / base:8.1f} {problem.cost(poses):18.8f}")
    speed = bandwidth_gb_s()
    print(f"\nmemory, one thread: {speed:.1f} GB/s; 40 bytes a correspondence: {40 / speed:.2f} ns")
    for count in (100_000, 4_000_000):
        print(f"one pass over {count}: {pass_ns(count):.2f} ns a correspondence")


if __name__ == "__main__":
    main()
