"""The page's section about one camera: its checks as rows of a table, its diagrams, one point."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.model.calibration import Calibration
from calibgraph.model.geometry import degrees_and_centimetres, invert, point_in_lidar
from calibgraph.model.lens import has_other_lens
from calibgraph.model.metrics import PoseError, pose_error
from calibgraph.model.rig import Camera
from calibgraph.model.verdict import Check, Direction, Verdict, beside, in_unit, is_reachable
from calibgraph.report import plots
from calibgraph.report.page_overlays import width_on_page
from calibgraph.report.reprojection_errors import ReprojectionErrors

_WORST_FIRST = ("FAIL", "WARN", "PASS")


@dataclass(frozen=True)
class CheckRow:
    """One check with its value and its thresholds, as text; empty where there is none."""

    check: Check
    found: str
    warn: str
    fail: str


def _severity(check: Check) -> int:
    return _WORST_FIRST.index(check.status)


def check_row(check: Check) -> CheckRow:
    """A check with its thresholds; their order gives the side on which values are bad.

    A status that the value does not give, since it depends on more, has none.
    """
    if check.value is None:
        return CheckRow(check, "", "", "")
    if check.warn is None or check.fail is None or not check.is_graded:
        return CheckRow(check, in_unit(check.value, check.unit), "", "")
    side: Direction = "at least" if check.warn > check.fail else "at most"
    warn, fail = (_threshold(side, limit, check.unit) for limit in (check.warn, check.fail))
    found = beside(check.value, check.fail if check.status == "FAIL" else check.warn, check.unit)
    return CheckRow(check, found, warn, fail)


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


@dataclass(frozen=True, eq=False)
class CameraSection:
    """What the template prints of one camera beside what the result has.

    Attributes:
        rows: its checks, the worst first.
        moved: change from the guess.
        sigmas, bootstrap: (3,) of rotation [deg], and of translation [cm]; None where there are
            none, or they do not hold.
        no_error_bar: why there is none; empty if there is one.
        overlays: the cloud on an image, before and after; None where there is no image.
        overlay_width_px: at most so wide they are shown.
        diagrams: pictures as data URIs, by the name of their caption in the template; those that
            the data allow.
        matrix, pose, inverse: of T_camera_lidar, and of the ROS transform, as text.
        worked: one point step by step.
    """

    name: str
    anchor: str
    verdict: Verdict
    rows: Sequence[CheckRow]
    moved: PoseError
    sigmas: Sequence[Array] | None
    bootstrap: Sequence[Array] | None
    no_error_bar: str
    overlays: tuple[str, ...] | None
    overlay_width_px: int
    diagrams: Mapping[str, str]
    matrix: str
    pose: str
    inverse: str
    worked: str


def camera_section(
    result: Calibration,
    name: str,
    index: int,
    overlays: tuple[str, ...] | None,
    *,
    errors: ReprojectionErrors | None,
    diagrams: Mapping[str, str],
) -> CameraSection:
    """Collect what the page shows of a camera."""
    camera, verdict = result.rig.cameras[name], result.camera_verdicts[name]
    bootstrap = result.bootstrap.get(name) if result.error_bar_holds(name) else None
    return CameraSection(
        name=name,
        anchor=f"camera-{index}",
        verdict=verdict,
        rows=[check_row(check) for check in sorted(verdict.checks, key=_severity)],
        moved=pose_error(result.T_camera_lidar[name], result.initial_rig.T_camera_lidar[name]),
        sigmas=result.error_bar(name),
        bootstrap=None if bootstrap is None else degrees_and_centimetres(bootstrap),
        no_error_bar=_why_no_error_bar(result, name),
        overlays=overlays,
        overlay_width_px=width_on_page(camera),
        diagrams=diagrams,
        matrix=matrix_text(camera.T_camera_lidar),
        pose=pose_text(camera.T_camera_lidar),
        inverse=pose_text(invert(camera.T_camera_lidar)),
        worked=worked_point(camera, errors),
    )


def _why_no_error_bar(result: Calibration, name: str) -> str:
    if not result.error_bar_holds(name):
        return "since the verdict is FAIL"
    return "not by these correspondences" if result.sigmas(name) is None else ""


def camera_diagrams(
    result: Calibration, name: str, errors: ReprojectionErrors | None
) -> dict[str, str]:
    """Residuals, coverage, lens and convergence of a camera, as data URIs by name."""
    found: dict[str, str] = {}
    before, camera = result.initial_rig.cameras[name], result.rig.cameras[name]
    if errors is not None:
        found["residuals"] = plots.residual_scatter(errors, result.residuals[name].sigma_px)
        found["by_distance"] = plots.residual_by_distance(errors)
        found["over_image"] = plots.residual_map(camera, errors)
        found["coverage"] = plots.coverage(camera, errors)
    if name in result.lens and has_other_lens(before, camera):
        found["lens"] = plots.lens_change(before, camera)
    rounds = [cameras[name] for cameras in result.rounds if name in cameras]
    if len(rounds) > 1:
        found["convergence"] = plots.convergence(rounds)
    return found
