"""Rendered streets with sensors that err, and the true alignment of their cameras.

A point that is delivered where it is not is seen by a camera at the pixel of the surface that the
beam met. The alignment of a camera is the pose that brings the delivered points of its view nearest
to these pixels, all of equal weight.
"""

import shutil
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from calibgraph import Camera, Intrinsics, Rig, load_dataset, simulate_street
from calibgraph.model.geometry import to_T_camera_lidar, to_T_lidar_camera, twist_between
from calibgraph.simulation.lidar import lidar_of
from calibgraph.simulation.rigs import rig_of
from factors import ProjectionBlock, block_factor
from tests.draws.cameras import camera_at
from tools.scenes.scan_errors import ScanErrors

ALIGNMENT = "alignment.yaml"
_MOST = 20_000  # points of a camera


def pair() -> Rig:
    """KITTI's stereo pair, of half the size."""
    lens = Intrinsics(fx=359.4, fy=359.4, cx=303.6, cy=92.6)
    places = {"left": (0.27, 0.06, -0.08), "right": (0.27, -0.48, -0.08)}
    return Rig(cameras={n: camera_at((620, 188), lens, xyz, 0.9) for n, xyz in places.items()})


def wide() -> Rig:
    """Two cameras of 93 degrees, half to the left and half to the right."""
    lens = Intrinsics(fx=303.0, fy=303.0, cx=319.5, cy=199.5)
    views = {"left": ((0.3, 0.2, -0.2), 35.0), "right": ((0.3, -0.2, -0.2), -35.0)}
    return Rig(cameras={n: camera_at((640, 400), lens, *view) for n, view in views.items()})


RIGS = (("pair", pair, 64), ("sample", partial(rig_of, "sample"), 64),
        ("wide", wide, 64), ("sector", partial(rig_of, "sample"), 32))  # fmt: skip
"""Name, rig and beams of the LiDAR; groups of streets take turns with them."""


def render(folder: Path, truth: Rig, beams: int, errors: ScanErrors, **options: Any) -> None:
    """Render a street of another layout than others."""
    shutil.rmtree(folder, ignore_errors=True)
    simulate_street(folder, truth, beams=beams, sensor_errors=errors, vary_layout=True, **options)


def true_points(points_m: np.ndarray, beams: int, errors: ScanErrors) -> np.ndarray:
    """(n, 3) the surfaces that the beams met, of points as they are delivered.

    Args:
        points_m: (n, 3) in the LiDAR's frame.
        beams: of the LiDAR.
        errors: elevations and motion; errors of ranges stay in the points.
    """
    x, y, z = points_m.T
    distance, azimuth = np.linalg.norm(points_m, axis=1), np.arctan2(y, x)
    reported = np.radians(lidar_of(beams).elevations_deg)
    elevation = np.arctan2(z, np.hypot(x, y))
    beam = np.abs(elevation[:, None] - reported).argmin(axis=1)
    elevation = elevation + np.radians(errors.elevations_deg)[beam]
    level = np.cos(elevation)
    met = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    met *= distance[:, None]
    met[:, 0] += errors.motion_m * azimuth / (2 * np.pi)
    return met


def aligned_rig(truth: Rig, stated: Rig, folder: Path, beams: int, errors: ScanErrors) -> Rig:
    """The rig with every camera at its alignment, by all clouds of a recording.

    Args:
        truth: mounts and lenses as they are.
        stated: lenses as their owner knows them, mounts as these fit best.
        folder: of the recording.
        beams: of the LiDAR.
        errors: of the LiDAR.
    """
    dataset = load_dataset(folder, truth)
    clouds = [frame.load_cloud()[:, :3] for frame in dataset.frames]
    points = np.concatenate(clouds).astype(np.float64)
    met = true_points(points, beams, errors)
    aligned = {
        name: _align(camera, stated.cameras[name], points, met)
        for name, camera in truth.cameras.items()
    }
    return stated.moved_to(aligned)


def _align(camera: Camera, stated: Camera, points: np.ndarray, met: np.ndarray) -> np.ndarray:
    """(4, 4) T_camera_lidar."""
    T = camera.T_camera_lidar
    pixels, in_front = camera.lens.project(met @ T[:3, :3].T + T[:3, 3])
    size = camera.width_px, camera.height_px
    inside = in_front & (pixels >= 0).all(axis=1) & (pixels < size).all(axis=1)
    rows = np.flatnonzero(inside)
    rows = rows[:: max(1, len(rows) // _MOST)]
    block = ProjectionBlock(stated.lens, points[rows], pixels[rows], scale=np.inf)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(block_factor(0, block))
    values.insert(0, to_T_lidar_camera(stated.T_camera_lidar))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return to_T_camera_lidar(found.atPose3(0))


def mean_poses(several: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Per camera, the mean of near (4, 4) T_camera_lidar."""
    first = several[0]
    steps = {
        name: np.mean([twist_between(of[name], first[name]) for of in several], axis=0)
        for name in first
    }
    return {name: gtsam.Pose3.Expmap(step).matrix() @ first[name] for name, step in steps.items()}
