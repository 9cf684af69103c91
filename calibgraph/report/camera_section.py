"""The page's section about one camera: its checks as rows of a table, its diagrams, one point."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.model.calibration import Calibration
from calibgraph.model.geometry import degrees_and_centimetres, invert, point_in_lidar
from calibgraph.model.lens_difference import has_other_lens
from calibgraph.model.metrics import PoseError, pose_error
from calibgraph.model.rig import Camera
from calibgraph.model.threshold import Direction, beside, in_unit, is_reachable
from calibgraph.model.verdict import Check, Verdict
from calibgraph.report import plots
from calibgraph.report.figure import ImageSize
from calibgraph.report.match_errors import BeforeAfter, ReprojectionErrors
from calibgraph.report.page_overlays import Overlays, width_on_page

_WORST_FIRST = ("FAIL", "WARN", "PASS")


@dataclass(frozen=True)
class CheckRow:
    """One check with its value and its thresholds, as text; empty where there is none."""

    check: Check
    found: str
    warn: str
    fail: str


def check_rows(checks: Sequence[Check]) -> tuple[CheckRow, ...]:
    """The rows of a camera's checks, the worst first."""
    return tuple(check_row(check) for check in sorted(checks, key=_severity))


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


Sigmas = tuple[list[float], list[float]]
"""Standard deviations of rotation [deg] and translation [cm], per axis."""


@dataclass(frozen=True, eq=False)
class CameraSection:
    """What the template prints of one camera beside what the result has.

    Attributes:
        rows: its checks.
        moved: change from the guess.
        sigmas, bootstrap: None where there are none, or they do not hold.
        no_error_bar: why there is none; empty if there is one.
        overlays: None where there is no image.
        overlay_width_px: at most so wide they are shown.
        diagrams: pictures as data URIs, by the name of their caption in the template; those that
            the data allow.
        worked: one point step by step.
    """

    name: str
    anchor: str
    verdict: Verdict
    rows: tuple[CheckRow, ...]
    moved: PoseError
    sigmas: Sigmas | None
    bootstrap: Sigmas | None
    no_error_bar: str
    overlays: Overlays | None
    overlay_width_px: int
    diagrams: Mapping[str, str]
    worked: WorkedPoint


def camera_section(
    result: Calibration,
    name: str,
    index: int,
    overlays: Overlays | None,
    *,
    errors: BeforeAfter | None,
    diagrams: Mapping[str, str],
) -> CameraSection:
    """Collect what the page shows of a camera."""
    camera, verdict = result.rig.cameras[name], result.camera_verdicts[name]
    return CameraSection(
        name=name,
        anchor=f"camera-{index}",
        verdict=verdict,
        rows=check_rows(verdict.checks),
        moved=pose_error(result.T_camera_lidar[name], result.initial_rig.T_camera_lidar[name]),
        sigmas=_sigmas(result, result.covariance, name),
        bootstrap=_sigmas(result, result.bootstrap, name),
        no_error_bar=_why_no_error_bar(result, name),
        overlays=overlays,
        overlay_width_px=width_on_page(camera),
        diagrams=diagrams,
        worked=worked_point(camera, None if errors is None else errors.after),
    )


def _sigmas(
    result: Calibration, covariances: Mapping[str, Array | None], name: str
) -> Sigmas | None:
    covariance = covariances.get(name) if result.error_bar_holds(name) else None
    if covariance is None:
        return None
    rotation_deg, translation_cm = degrees_and_centimetres(covariance)
    return rotation_deg.tolist(), translation_cm.tolist()


def _why_no_error_bar(result: Calibration, name: str) -> str:
    if not result.error_bar_holds(name):
        return "since the verdict is FAIL"
    return "not by these correspondences" if result.sigmas(name) is None else ""


def camera_diagrams(result: Calibration, name: str, errors: BeforeAfter | None) -> dict[str, str]:
    """Residuals, coverage, error bars and convergence of a camera, as data URIs by name."""
    found: dict[str, str] = {}
    before, camera = result.initial_rig.cameras[name], result.rig.cameras[name]
    if errors is not None:
        size, after = ImageSize.of(camera), errors.after
        sigma_px = result.residuals[name].sigma_px
        found["residuals"] = plots.residual_scatter(after, sigma_px)
        found["by_distance"] = plots.residual_by_distance(after)
        found["over_image"] = plots.residual_map(size, after)
        found["coverage"] = plots.coverage(size, after)
        found["distances"] = plots.distances(after)
    if name in result.lens and has_other_lens(before, camera):
        found["lens"] = plots.lens_change(before, camera)
    sigmas, bootstrap = result.error_bar(name), result.bootstrap.get(name)
    if sigmas is not None:
        others = None if bootstrap is None else degrees_and_centimetres(bootstrap)
        found["error_bars"] = plots.error_bars(sigmas, others)
    rounds = [cameras[name] for cameras in result.rounds if name in cameras]
    if len(rounds) > 1:
        found["convergence"] = plots.convergence(rounds)
    return found
