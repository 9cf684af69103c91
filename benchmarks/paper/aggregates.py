"""The paper's other ways from the extrinsics of frames to one: their mean, and their mode."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.model.geometry import transform
from calibgraph.solver.stage1 import median_pose

Array = np.ndarray


def aggregate(T_camera_lidar: Array, how: str) -> Array:
    """(4, 4) one extrinsic from those of several frames.

    Args:
        T_camera_lidar: (f, 4, 4), f >= 1.
        how: ``median``, as ours; ``mean``: arithmetic and chordal; ``mode``: half-sample mode of
            each component, the rotation's in the tangent at its median.
    """
    if how == "median":
        return median_pose(T_camera_lidar)
    rotations = Rotation.from_matrix(T_camera_lidar[:, :3, :3])
    translations = T_camera_lidar[:, :3, 3]
    if how == "mean":
        return transform(rotations.mean(), translations.mean(axis=0))
    median = Rotation.from_matrix(median_pose(T_camera_lidar)[:3, :3])
    tangents = (rotations * median.inv()).as_rotvec()
    mode = np.array([half_sample_mode(column) for column in tangents.T])
    translation = [half_sample_mode(column) for column in translations.T]
    return transform(Rotation.from_rotvec(mode) * median, translation)


def half_sample_mode(samples: Sequence[float] | Array) -> float:
    """Mode of a sample: keep the densest half, again and again (Bickel and Fruehwirth 2006)."""
    x = np.sort(np.asarray(samples, dtype=np.float64))
    while len(x) > 2:  # noqa: PLR2004 - two values have no denser half
        half = (len(x) + 1) // 2
        widths = x[half - 1 :] - x[: len(x) - half + 1]
        start = int(np.argmin(widths))
        x = x[start : start + half]
    return float(x.mean())
