"""The page's section about one camera: its checks as rows of a table, and its diagrams."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from calibgraph.arrays import Array
from calibgraph.model.calibration import Calibration
from calibgraph.model.geometry import degrees_and_centimetres
from calibgraph.model.metrics import PoseError, pose_error
from calibgraph.model.threshold import Direction, beside, in_unit, is_reachable
from calibgraph.model.verdict import Check, Verdict
from calibgraph.report import plots
from calibgraph.report.page_overlays import Overlays, width_on_page
from calibgraph.report.reprojection_errors import BeforeAfter
from calibgraph.report.worked_point import WorkedPoint, worked_point

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


Sigmas = tuple[list[float], list[float]]
"""Standard deviations of rotation [deg] and translation [cm], per axis."""


@dataclass(frozen=True, eq=False)
class CameraSection:
    """What the template prints of one camera beside what the result has.

    Attributes:
        name: of the camera.
        anchor: of its section in the page.
        verdict: of the camera.
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
        diagrams=camera_diagrams(result, name, errors),
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
    """Residuals, coverage, error bars and convergence of a camera: data URIs by name."""
    found: dict[str, str] = {}
    if errors is not None:
        camera, after = result.rig.cameras[name], errors.after
        found["residuals"] = plots.residual_scatter(after, result.residuals[name].sigma_px)
        found["by_distance"] = plots.residual_by_distance(after)
        found["over_image"] = plots.residual_map(camera, after)
        found["coverage"] = plots.coverage(camera, after)
        found["distances"] = plots.distances(after)
    sigmas, bootstrap = result.error_bar(name), result.bootstrap.get(name)
    if sigmas is not None:
        others = None if bootstrap is None else degrees_and_centimetres(bootstrap)
        found["error_bars"] = plots.error_bars(sigmas, others)
    rounds = [cameras[name] for cameras in result.rounds if name in cameras]
    if len(rounds) > 1:
        found["convergence"] = plots.convergence(rounds)
    return found
