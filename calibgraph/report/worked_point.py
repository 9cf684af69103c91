"""One point projected step by step, to show the conventions."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.model.geometry import invert, point_in_lidar
from calibgraph.model.rig import Camera
from calibgraph.report.reprojection_errors import ReprojectionErrors

_DISTANCE_M = 10.0


@dataclass(frozen=True)
class WorkedPoint:
    """One point from the LiDAR frame to the pixel, as text."""

    matrix: str
    pose: str
    inverse: str
    steps: str
    origin: str


def worked_point(camera: Camera, errors: ReprojectionErrors | None) -> WorkedPoint:
    """Project the used correspondence nearest to 10 m, or a point on the optical axis."""
    T = camera.T_camera_lidar
    used = None if errors is None else errors.select(errors.is_inlier)
    if used is None or not len(used.frame):
        point = point_in_lidar(T, np.array([0.0, 0.0, _DISTANCE_M]))
        origin, matched = "a point 10 m ahead on the optical axis", ""
    else:
        row = int(np.argmin(np.abs(used.distances_m - _DISTANCE_M)))
        point, pixel = used.points_lidar_m[row], used.pixels_px[row]
        origin = f"a correspondence of frame {used.frame[row]}"
        matched = (
            f"\nmatched pixel            = ({pixel[0]:.2f}, {pixel[1]:.2f}) px, "
            f"residual {used.sizes_px[row]:.2f} px"
        )
    steps = _steps(camera, point) + matched
    return WorkedPoint(matrix_text(T), pose_text(T), pose_text(invert(T)), steps, origin)


def _steps(camera: Camera, point: Array) -> str:
    T = camera.T_camera_lidar
    rotated = T[:3, :3] @ point
    p_camera = rotated + T[:3, 3]
    pixel = camera.lens.project(p_camera[None])[0][0]
    return (
        f"p_lidar                  = {_vector(point)} m\n"
        f"R p_lidar                = {_vector(rotated)} m\n"
        f"p_camera = R p_lidar + t  = {_vector(p_camera)} m\n"
        f"{_lens_steps(camera, p_camera)}\n"
        f"projected pixel (u, v)   = ({pixel[0]:.2f}, {pixel[1]:.2f}) px"
    )


def _lens_steps(camera: Camera, p_camera: Array) -> str:
    """From p_camera to the pixel: the formula if the lens has no distortion, else its name."""
    k = camera.intrinsics_px
    if camera.model == "pinhole" and not any(camera.distortion):
        x, y, z = p_camera
        return (
            f"u = fx x/z + cx          = {k.fx:.3f} * {x:.3f} / {z:.3f} + {k.cx:.3f}\n"
            f"v = fy y/z + cy          = {k.fy:.3f} * {y:.3f} / {z:.3f} + {k.cy:.3f}"
        )
    coefficients = ", ".join(f"{c:g}" for c in camera.distortion)
    return f"lens: {camera.model}, distortion {coefficients}"


def _vector(values: Array) -> str:
    return f"({', '.join(f'{value:.3f}' for value in values)})"


def matrix_text(T: Array) -> str:
    """The rows of a matrix, a line each."""
    return "\n".join(" ".join(f"{value: .6f}" for value in row) for row in T)


def pose_text(T: Array) -> str:
    """Translation and quaternion of a transform, with their order and unit."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    return (
        f"translation x y z   = {' '.join(f'{v:.6f}' for v in T[:3, 3])} m\n"
        f"quaternion  x y z w = {x:.6f} {y:.6f} {z:.6f} {w:.6f}"
    )
