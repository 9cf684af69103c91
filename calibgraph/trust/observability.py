"""Weakly observable parts of a solution, in words: weakest direction, empty parts."""

from __future__ import annotations

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.geometry import camera_center
from calibgraph.model.rig import Camera
from calibgraph.solver.matches import CameraBlock
from calibgraph.solver.robust import quantile
from calibgraph.solver.solution import Solution
from factors.conditioning import invert_or_none

_ROTATIONS = ("about x (pitch)", "about y (yaw)", "about z (roll)")
_SHIFTS = ("along x (right)", "along y (down)", "along z (the optical axis)")
_UNITS = np.repeat([np.radians(0.15), 0.05], 3)  # errors that weigh alike: 0.15 deg, 5 cm
_MENTIONED = 0.4  # of the largest component: smaller ones are left out of the sentence
_THIRDS = ("left", "middle", "right")
_EMPTY, _SPARSE = 0.002, 0.05  # share of the matches in a third of the image
_NEAR_M, _FAR_M = 6.0, 20.0
_SHALLOW = 2.0  # ratio of far to near


def weaknesses(solution: Solution, camera: str, covariance: Array | None) -> tuple[str, ...]:
    """Sentences about weakly observable parameters of one camera, the most important first.

    By the (6, 6) covariance of its pose; if there is none, by that of independent matches.
    """
    block = solution.inliers.blocks.get(camera)
    if block is None or not solution.objective.uses_correspondences:
        return ()
    how = "weakest direction"
    if covariance is None:
        how = "weakest direction, by the matches as if each were independent"
        independent = solution.fitted.projections[camera].sums(solution.fitted.pose(camera))
        covariance = invert_or_none(independent.hessian)
    direction = [] if covariance is None else [f"{how}: {weakest_direction(covariance)}"]
    T = solution.T_camera_lidar[camera]
    return (*direction, *empty_parts(solution.rig.cameras[camera], block, T))


def weakest_direction(covariance: Array) -> str:
    """The eigenvector of a (6, 6) covariance's largest standard deviation, in words.

    Rotations [rad] and translations [m] are compared relative to their tolerances.
    """
    values, vectors = np.linalg.eigh(covariance / np.outer(_UNITS, _UNITS))
    component = vectors[:, -1] * np.sqrt(values[-1])
    large = np.abs(component) >= _MENTIONED * np.abs(component).max()
    sigmas = np.abs(component * _UNITS)
    turns = [f"turn {_ROTATIONS[i]} {np.degrees(sigmas[i]):.2g} deg" for i in range(3) if large[i]]
    shifts = [f"shift {_SHIFTS[i]} {100 * sigmas[i + 3]:.2g} cm" for i in range(3) if large[i + 3]]
    together = ", together" if len(turns) + len(shifts) > 1 else ""
    return f"{' and '.join(shifts + turns)} (1 sigma{together})"


def empty_parts(camera: Camera, block: CameraBlock, T_camera_lidar: Array) -> list[str]:
    """Sentences about the parts of the image and of depth that have no matches."""
    columns = np.clip(3 * (block.block.pixels_px[:, 0] + 0.5) / camera.width_px, 0, 2.999)
    shares = np.bincount(columns.astype(np.int64), minlength=3) / len(columns)
    words = []
    for third, share in zip(_THIRDS, shares, strict=True):
        if share < _SPARSE:
            few = "no matches" if share < _EMPTY else f"only {share:.1%} of the matches"
            words.append(f"the {third} third of the image has {few}")
    x, y, z = block.block.points_lidar_m.T - camera_center(T_camera_lidar)[:, None]
    distances = np.sqrt(x * x + y * y + z * z)
    near, far = quantile(distances, 0.02), quantile(distances, 0.98)
    if near > _NEAR_M:
        words.append(f"nothing nearer than {near:.2g} m")
    if far < _FAR_M:
        words.append(f"nothing farther than {far:.2g} m")
    if far < _SHALLOW * near:
        words.append("all at about one distance: turn and shift are hard to distinguish")
    return words
