"""The page's section about one camera: its checks as cells of a table, its diagrams, one point."""

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.model.calibration import Calibration
from calibgraph.model.geometry import point_in_lidar
from calibgraph.model.rig import Camera
from calibgraph.model.verdict import Check, Direction, beside, in_unit, is_reachable
from calibgraph.report import plots
from calibgraph.report.reprojection_errors import ReprojectionErrors


def check_cells(check: Check) -> tuple[str, str, str]:
    """The value of a check and its thresholds, as text; empty where there is none.

    The order of the thresholds gives the side on which values are bad. A status that the value
    does not give, since it depends on more, has none.
    """
    if check.value is None:
        return "", "", ""
    if check.warn is None or check.fail is None or not check.is_graded:
        return in_unit(check.value, check.unit), "", ""
    side: Direction = "at least" if check.warn > check.fail else "at most"
    warn, fail = (_threshold(side, limit, check.unit) for limit in (check.warn, check.fail))
    found = beside(check.value, check.fail if check.status == "FAIL" else check.warn, check.unit)
    return found, warn, fail


def _threshold(side: Direction, limit: float, unit: str) -> str:
    """When a value is bad; empty if no value can be."""
    sign = ">" if side == "at most" else "<"
    return f"{sign} {in_unit(limit, unit)}" if is_reachable(limit, unit, side) else ""


_DISTANCE_M = 10.0


def worked_point(camera: Camera, errors: ReprojectionErrors | None) -> str:
    """Project the used correspondence nearest to 10 m, or a point on the optical axis, in lines."""
    T = camera.T_camera_lidar
    used = None if errors is None else errors.select(errors.is_inlier)
    if used is None or not len(used.frame):
        point, matched = point_in_lidar(T, np.array([0.0, 0.0, _DISTANCE_M])), ""
    else:
        row = int(np.argmin(np.abs(used.distances_m - _DISTANCE_M)))
        point, (u, v) = used.points_lidar_m[row], used.pixels_px[row]
        matched = (
            f"\nmatched pixel            = ({u:.2f}, {v:.2f}) px in frame {used.frame[row]}, "
            f"residual {used.sizes_px[row]:.2f} px"
        )
    p_camera, k = T[:3, :3] @ point + T[:3, 3], camera.intrinsics_px
    u, v = camera.lens.project(p_camera[None])[0][0]
    distortion = ", ".join(f"{each:g}" for each in camera.distortion) or "none"
    return (
        f"p_lidar                  = {_vector(point)} m\n"
        f"p_camera = R p_lidar + t = {_vector(p_camera)} m\n"
        f"lens                     = {camera.model}, fx {k.fx:.3f}, fy {k.fy:.3f}, "
        f"cx {k.cx:.3f}, cy {k.cy:.3f}; distortion {distortion}\n"
        f"projected pixel (u, v)   = ({u:.2f}, {v:.2f}) px{matched}"
    )


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


def camera_diagrams(
    result: Calibration, name: str, errors: ReprojectionErrors | None
) -> dict[str, str]:
    """Residuals, coverage and convergence of a camera, as data URIs by name."""
    found, camera = dict[str, str](), result.rig.cameras[name]
    if errors is not None:
        found["residuals"] = plots.residual_scatter(errors, result.residuals[name].sigma_px)
        found["by_distance"] = plots.residual_by_distance(errors)
        found["over_image"] = plots.residual_map(camera, errors)
        found["coverage"] = plots.coverage(camera, errors)
    rounds = [cameras[name] for cameras in result.rounds if name in cameras]
    if len(rounds) > 1:
        found["convergence"] = plots.convergence(rounds)
    return found
