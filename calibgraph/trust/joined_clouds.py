"""Clouds that hold the same surfaces twice, displaced: joined with a wrong extrinsic."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.model.geometry import angle_deg, transform

APART_DEG, APART_M = 0.5, 0.1
"""Least displacement that counts. On 19 recordings, 8 of them with clouds whose parts overlap,
parts of one scan were within 0.39 deg and 12 cm, and hardly fitted better for it."""
_SPLITS = (0.5, 0.75, 0.25)
"""Where a cloud may be joined of two, whose points follow one another: of equal or other sizes."""
_RANGE_M = 2.0, 50.0  # without the vehicle itself, and sparse points
_TARGET, _SOURCE, _NEIGHBOURS = 10_000, 1_500, 10  # points that are compared
_OVERLAP, _OVERLAP_M = 0.5, 0.5  # share of points with a neighbour so near; scans sweep on
_REACH_M = (2.0, 1.0, 0.5, 0.5, 0.3, 0.3)  # of neighbours, per step of the registration
_FLAT, _LINE, _PATCH_M2 = 0.02, 0.05, 1.0  # variances of neighbours on a surface, and not a line
_LEAST_POINTS, _LEAST_M = 100, 0.01
_EXPLAINED = 3.0  # root mean square of the motion along the normals, over what distance remains


def displacement_of_parts(points_m: NDArray[np.floating]) -> tuple[float, float] | None:
    """Displacement of two parts of a cloud that show the same surfaces: degrees and metres.

    Args:
        points_m: (n, >= 3) x y z, in the order of the file.

    Returns:
        None if they agree, or show different surfaces, as parts of one sweep do.
    """
    xyz = points_m[:, :3].astype(np.float64)
    distance_m = np.linalg.norm(xyz, axis=1)
    xyz = xyz[(distance_m > _RANGE_M[0]) & (distance_m < _RANGE_M[1])]
    for share in _SPLITS:
        first, second = np.split(xyz, [int(share * len(xyz))])
        T = _register(_thin(first, _TARGET), _thin(second, _SOURCE))
        if T is None:
            continue
        degrees, metres = angle_deg(T[:3, :3]), float(np.linalg.norm(T[:3, 3]))
        if degrees > APART_DEG or metres > APART_M:
            return degrees, metres
    return None


def _thin(points: Array, most: int) -> Array:
    return points[:: max(1, len(points) // most)]


def _register(target: Array, source: Array) -> Array | None:
    """(4, 4) T_target_source, point to plane; None if it explains nothing, or too few overlap."""
    if min(len(target), len(source)) < _LEAST_POINTS:
        return None
    tree = cKDTree(target)
    if np.mean(tree.query(source)[0] < _OVERLAP_M) < _OVERLAP:
        return None
    T = np.eye(4)
    for reach_m in _REACH_M:
        moved = source @ T[:3, :3].T + T[:3, 3]
        moved, normals, offsets = _planes(target, tree, moved, reach_m)
        if len(moved) < _LEAST_POINTS:
            return None
        T = _step(moved, normals, offsets) @ T
    back = moved - (moved - T[:3, 3]) @ T[:3, :3]
    explained_m = math.sqrt(np.mean(np.einsum("ni,ni->n", back, normals) ** 2))
    return T if explained_m > _EXPLAINED * _spread_m(offsets) else None


def _spread_m(offsets_m: Array) -> float:
    """The robust standard deviation of distances, at least the noise of a good LiDAR."""
    return max(_LEAST_M, 1.5 * float(np.median(np.abs(offsets_m))))


def _planes(
    target: Array, tree: cKDTree, points: Array, reach_m: float
) -> tuple[Array, Array, Array]:
    """Points near a surface of the target, its normals (n, 3), and the distances to it (n,)."""
    distance_m, index = tree.query(points, _NEIGHBOURS)
    near = distance_m[:, 0] < reach_m
    points, around = points[near], target[index[near]]
    middle = around.mean(axis=1)
    from_middle = around - middle[:, None]
    variances, axes = np.linalg.eigh(from_middle.transpose(0, 2, 1) @ from_middle / _NEIGHBOURS)
    flat = variances[:, 0] < _FLAT * variances[:, 1]
    flat &= (variances[:, 1] > _LINE * variances[:, 2]) & (variances[:, 2] < _PATCH_M2)
    points, normals = points[flat], axes[flat, :, 0]
    return points, normals, np.einsum("ni,ni->n", points - middle[flat], normals)


def _step(points: Array, normals: Array, offsets_m: Array) -> Array:
    """(4, 4) the motion of points that brings them nearer to their surfaces, robustly."""
    weights = 1.0 / (1.0 + (offsets_m / _spread_m(offsets_m)) ** 2)
    jacobian = np.hstack([np.cross(points, normals), normals])
    information = (jacobian * weights[:, None]).T @ jacobian
    information += 1e-5 * np.trace(information) * np.eye(6)  # a plane alone does not hold it
    step = -np.linalg.solve(information, (jacobian * weights[:, None]).T @ offsets_m)
    return transform(Rotation.from_rotvec(step[:3]), step[3:])
