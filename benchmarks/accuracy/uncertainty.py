"""Errors of many simulated draws against the reported covariances.

    python -m benchmarks.accuracy.uncertainty [--draws 200] [--frames 30] [--matches 100]

Errors of the simulated matcher: 1 px independent, 1 px shared by a camera's frame, 15 % outliers.
NEES is the squared error in the metric of its covariance; its mean over 6 should be 1. The region
that should hold 95 % of the errors is that of a chi-squared law with 6 degrees of freedom. For
comparison: (J^T J)^-1, the inverse of the information of independent correspondences.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from benchmarks.tables import Table, add_record_option, publish
from calibgraph import Camera, Config, Intrinsics, MatcherErrors, Rig, simulate_correspondences
from calibgraph.model.geometry import (
    relative_covariance,
    relative_transform,
    to_T_lidar_camera,
    twist_between,
)
from calibgraph.solver.joint import solve_joint
from calibgraph.solver.solution import Solution
from calibgraph.trust.evidence import Evidence

Array = NDArray[np.float64]

ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=1.0, outlier_share=0.15)
FORWARD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


COLUMNS = ("error of", "covariance", "mean NEES / 6", "in the 95 % region")


def main() -> None:
    """Draw, solve, and print one table."""
    options = parse_options()
    found: dict[tuple[str, str], list[float]] = {}
    for seed in range(options.draws):
        for of, covariance, nees in draw(options.frames, options.matches, seed):
            found.setdefault((of, covariance), []).append(nees)
    limit = chi2.ppf(0.95, 6)
    rows = [
        (*name, f"{np.mean(values) / 6:.2f}", f"{np.mean(np.array(values) < limit):.1%}")
        for name, values in found.items()
    ]
    title = f"{options.draws} draws, {options.frames} frames, {options.matches} matches each"
    table = Table(title, COLUMNS, tuple(rows))
    publish("accuracy.uncertainty", [table], record=options.record)


def parse_options() -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--matches", type=int, default=100)
    add_record_option(parser)
    return parser.parse_args()


def stereo() -> Rig:
    """A pair like KITTI's, half a metre apart."""
    lens = Intrinsics(fx=718.0, fy=718.0, cx=607.0, cy=185.0)
    cameras = {}
    for name, y_m in (("left", 0.1), ("right", -0.44)):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = FORWARD, -FORWARD @ [0.3, y_m, -0.1]
        cameras[name] = Camera(width_px=1241, height_px=376, intrinsics_px=lens, T_camera_lidar=T)
    return Rig(cameras=cameras)


def draw(frames: int, matches: int, seed: int) -> Iterator[tuple[str, str, float]]:
    """One draw: error of what, by which covariance, its NEES."""
    rig = stereo()
    table = simulate_correspondences(rig, frames=frames, matches=matches, errors=ERRORS, seed=seed)
    solved = solve_joint(rig, table, Config())
    ours = Evidence(solved, guess=rig).joint_covariance
    assert ours is not None
    errors = np.concatenate(
        [
            twist_between(T, rig.cameras[name].T_camera_lidar)
            for name, T in solved.T_camera_lidar.items()
        ]
    )
    for which, joint in (("by frames (ours)", ours), ("(J^T J)^-1", independent(solved))):
        for what, error, covariance in parts(solved, errors, joint):
            yield what, which, float(error @ np.linalg.solve(covariance, error))


def parts(solved: Solution, errors: Array, joint: Array) -> Iterator[tuple[str, Array, Array]]:
    """Each camera and the pair: its error and covariance."""
    for place, name in enumerate(solved.T_camera_lidar):
        rows = slice(6 * place, 6 * place + 6)
        yield name, errors[rows], joint[rows, rows]
    left, right = solved.T_camera_lidar.values()
    T_right_left = relative_transform(right, left)
    of_pair = errors[6:] - gtsam.Pose3(T_right_left).AdjointMap() @ errors[:6]
    yield "left->right", of_pair, relative_covariance(joint, 0, 1, T_right_left)


def independent(solved: Solution) -> Array:
    """(12, 12) inverse of the information of all inliers, taken for independent."""
    joint = np.zeros((12, 12))
    for place, (name, matches) in enumerate(solved.inliers.blocks.items()):
        rows = slice(6 * place, 6 * place + 6)
        block = matches.with_scale(solved.scales[name])
        sums = block.sums(to_T_lidar_camera(solved.T_camera_lidar[name]))
        joint[rows, rows] = np.linalg.inv(sums.hessian)
    return joint


if __name__ == "__main__":
    main()
