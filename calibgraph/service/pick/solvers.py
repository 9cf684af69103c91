"""PnP by several solvers, and the shape of the points that they are given."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.geometry import transform
from calibgraph.model.rig import Camera
from calibgraph.solver.pnp import magsac, ransac_on_plane, view_plane

Shape = Literal["line", "plane", "space"]

FLAT_M = 0.06
"""Root mean square distance from a line or plane up to which points lie on it: ranges have 2 to
3 cm of noise, so that two planes nearer than that are one."""
MIN_PAIRS = 4
"""Three pairs have up to four solutions; the fourth chooses."""
MIN_PAIRS_LINEAR = 6
"""From which OpenCV's iterative solver finds its own start."""

_INLIER_SIGMAS = 3.0
_ITERATIONS = 2000  # of samples of 4: with half of the pairs wrong, all but 1e-56 of runs have one


@dataclass(frozen=True, eq=False)
class SolverPose:
    """The (4, 4) extrinsic of a PnP solver, and the median error of all pairs, with the lens."""

    solver: str
    T_camera_lidar: Array
    median_px: float


@dataclass(frozen=True, eq=False)
class _Problem:
    points_m: Array
    pixels_px: Array  # of an ideal pinhole
    matrix: Array
    threshold_px: float


def poses_by_solver(
    camera: Camera, points_lidar_m: Array, pixels_px: Array, sigmas_px: Array, *, flat: bool
) -> list[SolverPose]:
    """The extrinsics of all solvers that find one.

    Args:
        camera: its lens.
        points_lidar_m: (n, 3).
        pixels_px: (n, 2) as recorded.
        sigmas_px: (n,), for the threshold of the robust solvers.
        flat: whether the points lie in one plane, for which there is IPPE.

    Returns:
        Sorted by the median error; IPPE with both of its solutions. Empty under MIN_PAIRS.
    """
    turn, plane = view_plane(camera, pixels_px)
    usable = np.isfinite(plane[:, 0])
    if np.count_nonzero(usable) < MIN_PAIRS:
        return []
    focal = camera.intrinsics_px.fx
    problem = _Problem(
        np.ascontiguousarray(points_lidar_m[usable]),
        np.ascontiguousarray(plane[usable] * focal),
        np.diag([focal, focal, 1.0]),
        _INLIER_SIGMAS * float(sigmas_px.max()),
    )
    solvers: dict[str, Callable[[_Problem], list[Array]]] = {
        "SQPnP": lambda p: _all_solutions(p, cv2.SOLVEPNP_SQPNP)[:1],
        "EPnP": lambda p: _all_solutions(p, cv2.SOLVEPNP_EPNP)[:1],
        "P3P + RANSAC": _p3p_ransac,
        "MAGSAC": _magsac,
    }
    if flat:
        solvers["IPPE"] = lambda p: _all_solutions(p, cv2.SOLVEPNP_IPPE)
    if np.count_nonzero(usable) >= MIN_PAIRS_LINEAR:
        solvers["iterative"] = lambda p: _all_solutions(p, cv2.SOLVEPNP_ITERATIVE)[:1]
    found = []
    for name, solver in solvers.items():
        for T in _transforms(solver, problem):
            T[:3] = turn.T @ T[:3]
            error = _median_error(camera, T, points_lidar_m, pixels_px)
            found.append(SolverPose(name, T, error))
    return sorted(found, key=lambda pose: pose.median_px)


def _transforms(solver: Callable[[_Problem], list[Array]], problem: _Problem) -> list[Array]:
    try:
        return [T for T in solver(problem) if np.isfinite(T).all()]
    except cv2.error:  # points in one place or on one line
        return []


def _all_solutions(problem: _Problem, method: int) -> list[Array]:
    _, rotations, translations, _ = cv2.solvePnPGeneric(
        problem.points_m, problem.pixels_px, problem.matrix, None, flags=method
    )
    return [_to_transform(r, t) for r, t in zip(rotations, translations, strict=True)]


def _p3p_ransac(problem: _Problem) -> list[Array]:
    cv2.setRNGSeed(0)
    found, rotation, translation, _ = cv2.solvePnPRansac(
        problem.points_m,
        problem.pixels_px,
        problem.matrix,
        None,
        iterationsCount=_ITERATIONS,
        reprojectionError=problem.threshold_px,
        confidence=0.999,
        flags=cv2.SOLVEPNP_P3P,
    )
    return [_to_transform(rotation, translation)] if found else []


def _magsac(problem: _Problem) -> list[Array]:
    parameters = magsac(problem.threshold_px, iterations=_ITERATIONS, seed=0)
    focal = float(problem.matrix[0, 0])
    plane = problem.pixels_px / focal
    found = ransac_on_plane(problem.points_m, plane, focal, parameters, turn=np.eye(3))
    return [] if found is None else [found[0]]


def _to_transform(rotation: Any, translation: Any) -> Array:
    return transform(cv2.Rodrigues(rotation)[0], translation.ravel())


def _median_error(camera: Camera, T: Array, points_lidar_m: Array, pixels_px: Array) -> float:
    """Median distance [px] of the projected points from the pixels; inf if most are behind."""
    projected, valid = camera.lens.project(points_lidar_m @ T[:3, :3].T + T[:3, 3])
    errors = np.linalg.norm(projected - pixels_px, axis=1)
    return float(np.median(np.where(valid, errors, np.inf)))


def shape_of(points_m: Array) -> tuple[Shape, float]:
    """Whether (n, 3) points lie on a line, in a plane, or neither, and how far off it [m], rms."""
    centred = points_m - points_m.mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(points_m))
    spread = np.pad(spread, (0, 3 - len(spread)))
    off_line = float(np.hypot(spread[1], spread[2]))
    if off_line <= FLAT_M:
        return "line", off_line
    return ("plane" if spread[2] <= FLAT_M else "space"), float(spread[2])
