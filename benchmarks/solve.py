"""Solve time: ours against the paper's own way (SciPy) and against separate GTSAM factors.

    python benchmarks/solve.py [--frames 10 100 1000] [--cameras 2 6 12] [--longest-s 300]

All minimize the same objective (paper, Eq. 5: Cauchy on the reprojection error, both priors, the
relative one over each camera with the next) from the same start, on simulated correspondences: N
frames, 1000 matches each in every camera, 15 % outliers; a stereo pair, or a ring of cameras. Ours
and SciPy's TRF do both passes: fit, drop what lies beyond the gate, fit again from there. What is
dropped is the same for both. The costs beside the times are all evaluated by one function. A way
that would take longer than --longest-s by what it took for fewer correspondences, or whose Jacobian
would not fit, is not run.

CPU: processor time of all threads, which other work on the machine does not add to; the ratios are
of this. Ours is the least of several runs.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibgraph import Camera, MatcherErrors, Rig, perturb, preset, simulate_correspondences
from calibgraph.evaluation.baselines import minimize_trf, prior_rows
from calibgraph.simulation.rigs import rig_of
from calibgraph.solver.camera_block import camera_blocks
from calibgraph.solver.factor_graph import join, objective_graph, pose_key, to_values
from calibgraph.solver.objective import Objective
from factors import projection_factor

Array = NDArray[np.float64]
Transforms = dict[str, Array]

CONFIG = preset("kitti").changed(stage1="rig")
ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=0.5, outlier_share=0.15)
SCALE_PX, GATE_PX = 4.0, 3.0  # the preset's
MATCHES = 1000
JACOBIAN_BYTES = 3e9  # of TRF, which keeps a few of them
FACTORS = 600_000  # more separate factors than these take gigabytes
PYTHON_FACTORS = 60_000


class World:
    """One problem, its start, and its objective."""

    def __init__(self, frames: int, cameras: int) -> None:
        rig = rig_of("kitti") if cameras == 2 else ring(cameras)
        self.table = simulate_correspondences(rig, frames=frames, matches=MATCHES, errors=ERRORS)
        self.rig = perturb(rig, rotation_deg=0.5, translation_m=0.05)
        self.cameras = list(rig.cameras)
        self.hat = self.rig.T_camera_lidar
        self.rows = {name: self.table.of_camera(name) for name in self.cameras}

    def gated(self, T: Transforms) -> World:
        """The problem without what lies beyond the gate at some poses."""
        inside = World.__new__(World)
        inside.__dict__.update(self.__dict__)
        inside.rows = {
            name: rows.select(np.linalg.norm(self.residuals(name, T[name]), axis=1) <= GATE_PX)
            for name, rows in self.rows.items()
        }
        return inside

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
        return prior_rows(T, self.hat, CONFIG)


def ring(count: int) -> Rig:
    """So many cameras of the stereo pair's kind, evenly all round, 40 cm from the LiDAR."""
    kind = next(iter(rig_of("kitti").cameras.values()))
    cameras: dict[str, Camera] = {}
    for k in range(count):
        out = np.eye(4)  # T_lidar_camera
        turn = Rotation.from_euler("z", 2 * np.pi * k / count).as_matrix()
        out[:3, :3] = turn @ np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
        out[:3, 3] = turn @ [0.4, 0.0, -0.2]
        cameras[f"camera_{k:02}"] = kind.moved_to(np.linalg.inv(out))
    return Rig(cameras=cameras)


@dataclass(frozen=True)
class Passes:
    """What a way found.

    Attributes:
        first: poses after the first pass.
        second: after the second; None if the way was not asked for it.
    """

    first: Transforms
    second: Transforms | None = None


def ours(world: World) -> Passes:
    """Both passes of calibgraph; the time includes building the graph."""
    problem = _problem(world)
    poses, scales = problem.settled(world.hat, CONFIG)
    inliers = problem.without_outliers(poses, scales)
    return Passes(poses, inliers.minimize(poses, scales).T_camera_lidar)


def ours_once(world: World) -> Passes:
    """The first pass alone, for comparison with those that do no more."""
    return Passes(_problem(world).settled(world.hat, CONFIG)[0])


def _problem(world: World) -> Objective:
    matches = camera_blocks(world.rig, world.table, CONFIG)
    known = objective_graph(world.rig, world.hat, CONFIG, "full")
    return Objective(tuple(world.cameras), matches, known, "full")


def scipy_trf(world: World, inliers: World) -> Passes:
    """The paper's way, twice."""
    first = one_trf(world, world.hat)
    return Passes(first, one_trf(inliers, first))


def one_trf(world: World, start: Transforms) -> Transforms:
    """One pass of TRF as the library's comparison with the paper runs it."""

    def residuals(T: Transforms) -> Array:
        return np.concatenate([world.residuals(name, T[name]) for name in world.cameras])

    return minimize_trf(residuals, world.prior_rows, start, scale_px=SCALE_PX)


def gtsam_stock(world: World) -> Passes:
    """GTSAM's C++ projection factor each, its landmark held fixed."""
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(SCALE_PX)
    noise = gtsam.noiseModel.Robust.Create(cauchy, gtsam.noiseModel.Unit.Create(2))
    graph, values = _start(world)
    landmark = 0
    for name, rows in world.rows.items():
        key, lens = pose_key(world.cameras, name), world.rig.cameras[name].intrinsics_px
        calibration = gtsam.Cal3_S2(lens.fx, lens.fy, 0.0, lens.cx, lens.cy)
        for point, pixel in zip(rows.points_lidar_m, rows.pixels_px, strict=True):
            graph.add(
                gtsam.GenericProjectionFactorCal3_S2(pixel, noise, key, landmark, calibration)
            )
            graph.add(gtsam.NonlinearEqualityPoint3(landmark, point))
            values.insert(landmark, point)
            landmark += 1
    return _gtsam_poses(world, graph, values)


def gtsam_python(world: World) -> Passes:
    """Our plain per-correspondence factor, a Python call each."""
    graph, values = _start(world)
    for name, rows in world.rows.items():
        key, lens = pose_key(world.cameras, name), world.rig.cameras[name].lens
        for point, pixel in zip(rows.points_lidar_m, rows.pixels_px, strict=True):
            graph.add(projection_factor(key, lens, point, pixel, scale=SCALE_PX))
    return _gtsam_poses(world, graph, values)


def _start(world: World) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    known = objective_graph(world.rig, world.hat, CONFIG, "full")
    return join(known), to_values(world.cameras, world.hat)


def _gtsam_poses(world: World, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> Passes:
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    keys = {name: pose_key(world.cameras, name) for name in world.cameras}
    return Passes({name: found.atPose3(key).inverse().matrix() for name, key in keys.items()})


@dataclass(frozen=True)
class Timed:
    """How a way did.

    Attributes:
        frames, cameras, correspondences: of the problem.
        way: its name.
        wall_s, cpu_s: least of several runs.
        ratio: of processor time to ours, of as many passes.
        cost_1: the objective after the first pass.
        cost_2: after the second, of the correspondences within the gate; None without one.
    """

    frames: int
    cameras: int
    correspondences: int
    way: str
    wall_s: float
    cpu_s: float
    ratio: float
    cost_1: float
    cost_2: float | None


@dataclass
class Bench:
    """The problems so far: what each way took, to tell what it would take."""

    longest_s: float
    rows: list[Timed]
    seconds: dict[str, tuple[int, float]]

    def compare(self, frames: int, cameras: int) -> None:
        """Time every way on one problem and print a line each."""
        world = World(frames, cameras)
        inliers = world.without_outliers(ours(world).first)
        size = frames, cameras, len(world.table)
        print(f"\nN = {frames} frames, {cameras} cameras, {size[2]} correspondences")
        print(
            f"{'':34} {'wall s':>9} {'CPU s':>9} {'ratio':>7} {'cost, pass 1':>18} {'pass 2':>18}"
        )
        base = {
            2: self._timed("calibgraph", lambda: ours(world), size, (world, inliers), None),
            1: self._timed("calibgraph, pass 1", lambda: ours_once(world), size,
                           (world, inliers), None),
        }  # fmt: skip
        count, jacobian = size[2], 16 * size[2] * 6 * cameras  # two rows each
        ways: list[tuple[str, Callable[[], Passes], int, bool]] = [
            ("SciPy TRF", lambda: scipy_trf(world, inliers), 2, jacobian < JACOBIAN_BYTES),
            ("GTSAM, C++ factor each, pass 1", lambda: gtsam_stock(world), 1, count <= FACTORS),
            ("GTSAM, Python factor each, pass 1", lambda: gtsam_python(world), 1,
             count <= PYTHON_FACTORS),
        ]  # fmt: skip
        for way, run, passes, fits in ways:
            expected = self._expected(way, count * cameras if "TRF" in way else count)
            if fits and expected < self.longest_s:
                self._timed(way, run, size, (world, inliers), base[passes])
            else:
                why = f"would take about {expected:.0f} s" if fits else "too large"
                print(f"{way:34} not run: {why}", flush=True)

    def _expected(self, way: str, work: int) -> float:
        """Seconds that a way would take, by its largest problem so far."""
        done, seconds = self.seconds.get(way, (1, 0.0))
        return seconds * work / done

    def _timed(
        self,
        way: str,
        run: Callable[[], Passes],
        size: tuple[int, int, int],
        worlds: tuple[World, World],
        base_cpu_s: float | None,
    ) -> float:
        """Run, print, remember; returns the processor time."""
        repeats = int(np.clip(4e6 / size[2], 3, 30)) if base_cpu_s is None else 1
        wall_s, cpu_s = np.inf, np.inf
        for _ in range(repeats):
            wall, cpu = time.perf_counter(), time.process_time()
            found = run()
            wall_s = min(wall_s, time.perf_counter() - wall)
            cpu_s = min(cpu_s, time.process_time() - cpu)
        world, inliers = worlds
        second = None if found.second is None else inliers.cost(found.second)
        timed = Timed(*size, way, wall_s, cpu_s, cpu_s / (base_cpu_s or cpu_s),
                      world.cost(found.first), second)  # fmt: skip
        self.rows.append(timed)
        work = size[2] * size[1] if "TRF" in way else size[2]
        if work >= self.seconds.get(way, (0, 0.0))[0]:
            self.seconds[way] = work, wall_s
        costs = f"{timed.cost_1:18.6f} " + ("" if second is None else f"{second:18.6f}")
        print(f"{way:34} {wall_s:9.4f} {cpu_s:9.4f} {timed.ratio:7.1f} {costs}", flush=True)
        return cpu_s


def main() -> None:
    """Print one table per problem."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, nargs="+", default=[10, 100, 1000])
    parser.add_argument("--cameras", type=int, nargs="+", default=[2, 6, 12])
    parser.add_argument("--longest-s", type=float, default=300.0)
    parser.add_argument("--json", type=Path, help="write the numbers into this file, too")
    options = parser.parse_args()
    ours(World(1, 2))  # compile
    bench = Bench(options.longest_s, [], {})
    for cameras in options.cameras:
        for frames in options.frames:
            bench.compare(frames, cameras)
            if options.json is not None:
                content: list[dict[str, Any]] = [asdict(row) for row in bench.rows]
                options.json.write_text(json.dumps(content, indent=1), "utf-8")


if __name__ == "__main__":
    main()
