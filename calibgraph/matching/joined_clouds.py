"""What errors of the poses of other LiDARs do to cameras that are matched with joined clouds.

A point of another LiDAR errs by its pose: with H the Hessian of a camera's matches, H_l that of
those with points of LiDAR l, and eta the error of its pose, p_base = exp(eta) T_base_lidar p_lidar,
a camera errs by xi = - H^-1 H_l Ad(T) eta, with T_camera_lidar = exp(xi) estimate.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calibgraph.arrays import Array
from calibgraph.io.dataset import Dataset
from calibgraph.io.frame import Frame
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.geometry import adjoints
from calibgraph.model.rig import Rig
from calibgraph.solver.matches import camera_block
from calibgraph.solver.within_place import WEAK


def with_lidar_errors(table: Correspondences, data: Dataset, rig: Rig) -> Correspondences:
    """The table with what the LiDARs of joined clouds add to the error bars, in its findings."""
    if not data.lidar_errors:
        return table
    errors = errors_by_lidars(table, data, rig)
    content = {name: columns.tolist() for name, columns in errors.items()}
    return table.with_findings(replace(table.findings, by_lidars=content))


def errors_by_lidars(table: Correspondences, data: Dataset, rig: Rig) -> dict[str, Array]:
    """Per camera, (6, k) xi by a standard deviation of each of the errors of LiDARs.

    Args:
        table: with points of joined clouds.
        data: that they are from.
        rig: where the cameras are.
    """
    sources, found = _sources(table, data.frames, [*data.lidar_errors]), {}
    for number, name in enumerate(table.cameras):
        rows = np.flatnonzero(table.camera_index == number)
        if len(rows) == 0:
            continue
        order = rows[np.argsort(table.frame[rows], kind="stable")]
        camera, own = rig.cameras[name], sources[order]
        block = camera_block(camera, table.select(order), Config()).block
        T, pulls = camera.T_camera_lidar[None], list[Array]()
        for k, twists in enumerate(data.lidar_errors.values()):
            part = block.select(own == k).summarize(T).hessian[0] if (own == k).any() else WEAK * 0
            pulls.append(part @ adjoints(T)[0] @ twists)
        found[name] = -np.linalg.solve(block.summarize(T).hessian[0] + WEAK, np.sum(pulls, axis=0))
    return found


def _sources(
    table: Correspondences, frames: Sequence[Frame], names: Sequence[str]
) -> NDArray[np.int64]:
    """(n,) the number of the LiDAR whose point is nearest to each match's, -1 of the base."""
    found = np.full(len(table), -1)
    for frame in frames:
        rows = np.flatnonzero(table.frame == frame.index)
        if not len(rows):
            continue
        points = table.points_lidar_m[rows]
        nearest = _distances(replace(frame, joined={}, kept=None).load_cloud(), points)
        for number, name in enumerate(names):
            cloud = frame.load_in_base(name) if name in frame.joined else None
            if cloud is not None:
                away = _distances(cloud, points)
                found[rows[away < nearest]] = number
                nearest = np.minimum(nearest, away)
    return found


def _distances(cloud: NDArray[np.float32], points: Array) -> Array:
    return np.asarray(cKDTree(cloud[:, :3]).query(points)[0])
