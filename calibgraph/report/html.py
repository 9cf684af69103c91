"""The page: everything that is said of a result, and the template that it is said by."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
import yaml
from jinja2 import Environment, StrictUndefined
from numpy.typing import NDArray

from calibgraph.files import write_text
from calibgraph.model.calibration import FRAMES_SENTENCE, TANGENT_SENTENCE, Calibration
from calibgraph.model.metrics import PoseError, pose_error
from calibgraph.model.rig import Camera
from calibgraph.model.verdict import Check, Verdict, in_unit
from calibgraph.report import plots
from calibgraph.report.frame_errors import BeforeAfter, Errors, errors_of
from calibgraph.report.overlays import Overlays, overlays_of
from calibgraph.report.worked_point import Worked, worked_point

Array = NDArray[np.float64]

CAN_I_USE_IT = {
    "PASS": "Yes. Nothing that was checked speaks against it.",
    "WARN": "With care: something was found wanting. Read the reasons, and look at the pictures.",
    "FAIL": "No. Do not use this result; the reasons below say what to mend.",
}

_FILTERS = {
    "given": "correspondences in the table",
    "projectable": "in front of the camera and inside the lens' domain",
    "confident": "confident enough (confidence_min)",
    "best_in_cell": "the most confident of its grid cell, per frame",
    "capped": "within the cap per camera and frame (matches_max)",
    "used": "inside the gate after the first pass: what the result is made from",
    "left_out": "frames left out, since they disagree with the estimate",
    "failed": "frames whose matches gave no pose",
    "frames": "frames with correspondences",
    "frames_used": "frames with used correspondences",
    "frames_waiting": "frames that wait for more of their kind",
    "outlier_frames": "frames left out, far from where frames are densest",
    "frames_without_pnp": "frames in which PnP found no pose",
}
_OVERLAY_HEIGHT_PX = 640  # at most, so that a picture and its caption fit on a screen
_FUNNEL = ("given", "projectable", "confident", "best_in_cell", "capped", "used")
_AXES = (
    ("rotation x (pitch)", "deg", "pitch_deg"),
    ("rotation y (yaw)", "deg", "yaw_deg"),
    ("rotation z (roll)", "deg", "roll_deg"),
    ("translation x (right)", "cm", "x_cm"),
    ("translation y (down)", "cm", "y_cm"),
    ("translation z (forward)", "cm", "z_cm"),
)


@dataclass(frozen=True)
class Row:
    """One check: what was found and the thresholds, in words."""

    check: Check
    found: str
    warn: str
    fail: str


@dataclass(frozen=True)
class Reason:
    """What was found wanting, and of which cameras."""

    status: str
    cameras: str
    text: str


@dataclass(frozen=True)
class Axis:
    """One axis of a pose: its error bar, how far it moved, the bootstrap's error bar."""

    name: str
    sigma: str
    change: str
    bootstrap: str


@dataclass(frozen=True)
class Count:
    """What was left after a filter."""

    name: str
    number: int
    share: float | None
    meaning: str


@dataclass(frozen=True)
class Picture:
    """A diagram with what it shows."""

    title: str
    uri: str
    caption: str


@dataclass(frozen=True, eq=False)
class CameraPage:
    """What is shown of one camera."""

    name: str
    anchor: str
    verdict: Verdict
    rows: tuple[Row, ...]
    weaknesses: tuple[str, ...]
    prior_share: float
    moved: PoseError
    sigmas: tuple[Array, Array] | None
    numbers: tuple[str, ...]
    overlays: Overlays | None
    overlay_width_px: int
    pictures: tuple[Picture, ...]
    axes: tuple[Axis, ...]
    counts: tuple[Count, ...]
    convergence: str | None
    worked: Worked


def write_report(result: Calibration, path: Path | str) -> Path:
    """Write a result as one HTML page that needs nothing else: no network, no files beside it.

    Images and clouds are read again from the files that the result names; if that cannot be, the
    page says so and leaves their pictures out.

    Args:
        result: any result; without correspondences the residuals' pictures are left out.
        path: of the page.

    Returns:
        The path.

    Raises:
        CorrespondenceError: if the result's correspondences do not belong to its rig.
        FileError: if the page cannot be written.
    """
    path = Path(path)
    write_text(path, report_html(result))
    return path


def report_html(result: Calibration) -> str:
    """The page as text; see :func:`write_report`."""
    errors = errors_of(result)
    overlays, left_out = overlays_of(result, errors)
    cameras = [
        _camera(result, name, index, overlays.get(name), errors.get(name))
        for index, name in enumerate(result.rig.cameras)
    ]
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = files("calibgraph.report").joinpath("page.html.j2").read_text("utf-8")
    return environment.from_string(template).render(
        result=result,
        cameras=cameras,
        usable=CAN_I_USE_IT[result.verdict.status],
        accuracy=_accuracy(result),
        pairs={name: result.sigmas(name) for name in result.pair_covariance},
        reasons=_reasons(cameras),
        overlays_left_out=left_out,
        residuals_left_out=not errors,
        config=yaml.safe_dump(result.config.model_dump(), sort_keys=False, allow_unicode=True),
        frames_sentence=FRAMES_SENTENCE,
        tangent_sentence=TANGENT_SENTENCE,
    )


def _reasons(cameras: Sequence[CameraPage]) -> list[Reason]:
    """What is weak, the worst first; what is true of several cameras is said once."""
    alike: dict[tuple[str, ...], dict[str, Check]] = {}
    said: dict[str, list[str]] = {}
    for camera in cameras:
        for check in camera.verdict.checks:
            measured = check.value is not None and check.warn is not None
            what = (check.status, check.name, check.unit, "" if measured else check.text)
            if check.status != "PASS":
                alike.setdefault(what, {})[camera.name] = check
        for sentence in camera.weaknesses:
            said.setdefault(sentence, []).append(camera.name)
    found = [Reason(key[0], ", ".join(each), _in_one(each)) for key, each in alike.items()]
    found.sort(key=lambda reason: ("FAIL", "WARN").index(reason.status))
    return [*found, *(Reason("", ", ".join(who), text) for text, who in said.items())]


def _in_one(checks: Mapping[str, Check]) -> str:
    """What one check found of some cameras, in one sentence, with the advice of the first."""
    first = next(iter(checks.values()))
    limit = first.fail if first.status == "FAIL" else first.warn
    if len({check.text for check in checks.values()}) == 1 or limit is None:
        return first.text
    found = [f"{name} {in_unit(c.value or 0.0, c.unit)}" for name, c in checks.items()]
    advice = first.text.removeprefix(first.name).partition(": ")[2]
    text = f"{first.name}: {', '.join(found)}; limit {in_unit(limit, first.unit)}"
    return f"{text}: {advice}" if advice else text


def _accuracy(result: Calibration) -> str:
    """The worst error bars over all cameras, in a sentence."""
    sigmas = {name: result.sigmas(name) for name in result.rig.cameras}
    known = {name: both for name, both in sigmas.items() if both is not None}
    if not known:
        return "Too few frames to say."
    rotation = max(known, key=lambda name: float(known[name][0].max()))
    translation = max(known, key=lambda name: float(known[name][1].max()))
    text = (
        f"Worst axis of any camera: {known[rotation][0].max():.3f} deg ({rotation}) and "
        f"{known[translation][1].max():.2f} cm ({translation}), one standard deviation."
    )
    unknown = [name for name in sigmas if name not in known]
    return f"{text} Too few frames to say of {', '.join(unknown)}." if unknown else text


def _camera(
    result: Calibration,
    name: str,
    index: int,
    overlays: Overlays | None,
    errors: BeforeAfter | None,
) -> CameraPage:
    camera, verdict = result.rig.cameras[name], result.camera_verdicts[name]
    moved = pose_error(result.T_camera_lidar[name], result.initial_rig.T_camera_lidar[name])
    rounds = [part[name] for part in result.rounds if name in part]
    return CameraPage(
        name=name,
        anchor=f"camera-{index}",
        verdict=verdict,
        rows=tuple(_row(check) for check in verdict.checks),
        weaknesses=tuple(result.weaknesses.get(name, ())),
        prior_share=result.prior_share.get(name, 0.0),
        moved=moved,
        sigmas=result.sigmas(name),
        numbers=_numbers(result, name),
        overlays=overlays,
        overlay_width_px=round(_OVERLAY_HEIGHT_PX * camera.width_px / camera.height_px),
        pictures=_pictures(result, name, errors),
        axes=_axes(result, name, moved),
        counts=_counts(result.counts.get(name, {})),
        convergence=plots.convergence(rounds) if len(rounds) > 1 else None,
        worked=worked_point(camera, None if errors is None else errors.after),
    )


def _numbers(result: Calibration, name: str) -> tuple[str, ...]:
    """A camera's cells of the table on top: error bars, moves, residuals, counts."""
    moved = pose_error(result.T_camera_lidar[name], result.initial_rig.T_camera_lidar[name])
    sigmas, residuals = result.sigmas(name), result.residuals.get(name)
    counts = result.counts.get(name, {})
    return (
        "-" if sigmas is None else f"{sigmas[0].max():.3f}",
        "-" if sigmas is None else f"{sigmas[1].max():.2f}",
        f"{moved.rotation_error_deg:.2f}",
        f"{moved.translation_error_cm:.1f}",
        "-" if residuals is None else f"{residuals.median_px:.2f}",
        "-" if residuals is None else f"{residuals.inlier_share:.0%}",
        str(counts.get("used", "-")),
        str(counts.get("frames_used", "-")),
    )


def _row(check: Check) -> Row:
    """A check with its thresholds; which side is bad follows from their order."""
    if check.value is None:
        return Row(check, "", "", "")
    found = in_unit(check.value, check.unit)
    if check.warn is None or check.fail is None:
        return Row(check, found, "", "")
    side = "below" if check.warn > check.fail else "above"
    limits = [f"{side} {in_unit(limit, check.unit)}" for limit in (check.warn, check.fail)]
    never = side == "below" and check.fail <= 0
    return Row(check, found, limits[0], "" if never else limits[1])


def _axes(result: Calibration, name: str, moved: PoseError) -> tuple[Axis, ...]:
    sigmas = _six(result.covariance[name])
    others = _six(result.bootstrap.get(name))
    return tuple(
        Axis(
            name=label,
            sigma="" if sigmas is None else _number(sigmas[row], unit),
            change=f"{getattr(moved, key):+.2f} {unit}",
            bootstrap="" if others is None else _number(others[row], unit),
        )
        for row, (label, unit, key) in enumerate(_AXES)
    )


def _number(value: float, unit: str) -> str:
    return f"{value:.3f} {unit}" if unit == "deg" else f"{value:.2f} {unit}"


def _six(covariance: Array | None) -> Array | None:
    """(6,) standard deviations: rotation [deg], translation [cm]."""
    if covariance is None:
        return None
    sigmas = np.sqrt(np.diag(covariance))
    return np.concatenate([np.degrees(sigmas[:3]), 100.0 * sigmas[3:]])


def _counts(counts: Mapping[str, int]) -> tuple[Count, ...]:
    """The filters in order, then the rest; shares are of what was given."""
    given = max(counts.get("given", 0), 1)
    order = [key for key in (*_FILTERS, *counts) if key in counts]
    return tuple(
        Count(
            name=key.replace("_", " "),
            number=counts[key],
            share=min(counts[key] / given, 1.0) if key in _FUNNEL else None,
            meaning=_FILTERS.get(key, ""),
        )
        for key in dict.fromkeys(order)
    )


def _pictures(result: Calibration, name: str, errors: BeforeAfter | None) -> tuple[Picture, ...]:
    bars = _error_bars(result, name)
    if errors is None:
        return bars
    camera, sigma_px = result.rig.cameras[name], result.residuals[name].sigma_px
    return (
        *_residual_pictures(camera, errors.after, sigma_px),
        *_coverage_pictures(camera, errors.after),
        *bars,
    )


def _residual_pictures(camera: Camera, after: Errors, sigma_px: float) -> tuple[Picture, ...]:
    return (
        Picture(
            "Residuals",
            plots.residual_scatter(after, sigma_px),
            "Projected less matched pixel, all frames; of a match that is known across an edge "
            "only, the way from the edge.",
        ),
        Picture(
            "Residual against distance",
            plots.residual_by_distance(after),
            "A median that grows towards small distances hints at a wrong translation.",
        ),
        Picture(
            "Residuals over the image",
            plots.residual_map(camera, after),
            "Arrows point from match to projection. Random directions are noise; a pattern "
            "hints at wrong intrinsics.",
        ),
    )


def _coverage_pictures(camera: Camera, after: Errors) -> tuple[Picture, ...]:
    return (
        Picture(
            "Coverage of the image",
            plots.coverage(camera, after),
            "All frames together. White cells say nothing.",
        ),
        Picture(
            "Coverage of distances",
            plots.distances(after),
            "Near points tell the translation, far ones the rotation: both are needed.",
        ),
    )


def _error_bars(result: Calibration, name: str) -> tuple[Picture, ...]:
    sigmas, other = result.sigmas(name), _six(result.bootstrap.get(name))
    if sigmas is None:
        return ()
    beside = None if other is None else (other[:3], other[3:])
    caption = "One standard deviation, about and along the camera's axes."
    return (Picture("Error bars", plots.error_bars(sigmas, beside), caption),)
