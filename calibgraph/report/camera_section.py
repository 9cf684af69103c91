"""The page's section about one camera, with its diagrams."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.calibration import Calibration
from calibgraph.model.geometry import degrees_and_centimetres
from calibgraph.model.metrics import PoseError, pose_error
from calibgraph.model.rig import Camera
from calibgraph.model.verdict import Verdict
from calibgraph.report import plots
from calibgraph.report.check_table import CheckRow, check_rows
from calibgraph.report.page_overlays import Overlays, width_on_page
from calibgraph.report.reprojection_errors import BeforeAfter, ReprojectionErrors
from calibgraph.report.worked_point import WorkedPoint, worked_point

Array = NDArray[np.float64]

_COUNT_MEANINGS = {
    "given": "correspondences in the table",
    "projectable": "in front of the camera and inside the lens' domain",
    "confident": "confident enough (confidence_min)",
    "best_in_cell": "the most confident of its grid cell, per frame",
    "capped": "within the cap per camera and frame (matches_max)",
    "used": "inside the gate after the first pass; the result is made from these",
    "common_features": "features that other cameras see, too; the result is also made from these",
    "left_out": "frames left out, since they disagree with the estimate",
    "failed": "frames whose matches gave no pose",
    "frames": "frames with correspondences",
    "frames_used": "frames with used correspondences",
    "frames_waiting": "frames that wait for others that agree with them",
    "outlier_frames": "frames left out, far from where frames are densest",
    "repeated_frames": "frames of the same place or content as another one, counted as part of it",
    "places": "places that they are from, some 20 m apart; one that was visited twice counts once",
    "frames_without_pnp": "frames in which PnP found no pose",
}
_FILTERS = ("given", "projectable", "confident", "best_in_cell", "capped", "used")
_AXES = (
    ("rotation x (pitch)", "deg", "pitch_deg"),
    ("rotation y (yaw)", "deg", "yaw_deg"),
    ("rotation z (roll)", "deg", "roll_deg"),
    ("translation x (right)", "cm", "x_cm"),
    ("translation y (down)", "cm", "y_cm"),
    ("translation z (forward)", "cm", "z_cm"),
)


@dataclass(frozen=True)
class Axis:
    """One axis of an extrinsic: standard deviation, change from the guess, bootstrap's."""

    name: str
    sigma: str
    change: str
    bootstrap: str


@dataclass(frozen=True)
class Count:
    """A number of correspondences or frames; the filters also as a share of the given ones."""

    name: str
    number: int
    share: float | None
    meaning: str


@dataclass(frozen=True, eq=False)
class CameraSection:
    """Everything that the template prints of one camera."""

    name: str
    anchor: str
    verdict: Verdict
    rows: tuple[CheckRow, ...]
    weaknesses: tuple[str, ...]
    prior_share: float
    moved: PoseError
    no_error_bar: str  # why there is none; empty if there is one
    numbers: tuple[str, ...]
    overlays: Overlays | None
    overlay_width_px: int
    diagrams: tuple[Diagram, ...]
    axes: tuple[Axis, ...]
    counts: tuple[Count, ...]
    convergence: str | None
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
    moved = pose_error(result.T_camera_lidar[name], result.initial_rig.T_camera_lidar[name])
    rounds = [cameras[name] for cameras in result.rounds if name in cameras]
    return CameraSection(
        name=name,
        anchor=f"camera-{index}",
        verdict=verdict,
        rows=check_rows(verdict.checks),
        weaknesses=tuple(result.weaknesses.get(name, ())),
        prior_share=result.prior_share.get(name, 0.0),
        moved=moved,
        no_error_bar=_why_no_error_bar(result, name),
        numbers=_overview_cells(result, name, moved),
        overlays=overlays,
        overlay_width_px=width_on_page(camera),
        diagrams=camera_diagrams(result, name, errors),
        axes=_axes(result, name, moved),
        counts=_counts(result.counts.get(name, {})),
        convergence=plots.convergence(rounds) if len(rounds) > 1 else None,
        worked=worked_point(camera, None if errors is None else errors.after),
    )


def _overview_cells(result: Calibration, name: str, moved: PoseError) -> tuple[str, ...]:
    """A camera's cells of the table on top: error bars, change, residuals, counts."""
    sigmas, residuals = result.error_bar(name), result.residuals.get(name)
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


def _axes(result: Calibration, name: str, moved: PoseError) -> tuple[Axis, ...]:
    holds = result.error_bar_holds(name)
    sigmas = _sigma_cells(result.covariance[name] if holds else None)
    bootstrap = _sigma_cells(result.bootstrap.get(name) if holds else None)
    return tuple(
        Axis(
            name=label,
            sigma=sigmas[row],
            change=f"{getattr(moved, key):+.2f} {unit}",
            bootstrap=bootstrap[row],
        )
        for row, (label, unit, key) in enumerate(_AXES)
    )


def _why_no_error_bar(result: Calibration, name: str) -> str:
    if not result.error_bar_holds(name):
        return "since the verdict is FAIL"
    return "not by these correspondences" if result.sigmas(name) is None else ""


def _sigma_cells(covariance: Array | None) -> list[str]:
    """A standard deviation per axis with its unit; empty without a covariance."""
    if covariance is None:
        return [""] * len(_AXES)
    rotation_deg, translation_cm = degrees_and_centimetres(covariance)
    return [f"{v:.3f} deg" for v in rotation_deg] + [f"{v:.2f} cm" for v in translation_cm]


def _counts(counts: Mapping[str, int]) -> tuple[Count, ...]:
    """The filters in order, then the other counts."""
    given = max(counts.get("given", 0), 1)
    order = [key for key in (*_COUNT_MEANINGS, *counts) if key in counts]
    return tuple(
        Count(
            name=key.replace("_", " "),
            number=counts[key],
            share=min(counts[key] / given, 1.0) if key in _FILTERS else None,
            meaning=_COUNT_MEANINGS.get(key, ""),
        )
        for key in dict.fromkeys(order)
    )


@dataclass(frozen=True)
class Diagram:
    """A picture as a data URI, with its title and caption."""

    title: str
    uri: str
    caption: str


def camera_diagrams(
    result: Calibration, name: str, errors: BeforeAfter | None
) -> tuple[Diagram, ...]:
    """Residuals, coverage and error bars of a camera; those that its data allow."""
    bars = _error_bar_diagrams(result, name)
    if errors is None:
        return bars
    camera, sigma_px = result.rig.cameras[name], result.residuals[name].sigma_px
    return (
        *_residual_diagrams(camera, errors.after, sigma_px),
        *_coverage_diagrams(camera, errors.after),
        *bars,
    )


def _residual_diagrams(
    camera: Camera, after: ReprojectionErrors, sigma_px: float
) -> tuple[Diagram, ...]:
    return (
        Diagram(
            "Residuals",
            plots.residual_scatter(after, sigma_px),
            "Projected less matched pixel, all frames. For a match on an edge, which is known "
            "across the edge only, that component. The axes end at twice this camera's gate; "
            "other cameras have other scales.",
        ),
        Diagram(
            "Residual against distance",
            plots.residual_by_distance(after),
            "A median that grows towards small distances hints at a wrong translation.",
        ),
        Diagram(
            "Residuals over the image",
            plots.residual_map(camera, after),
            "Arrows point from match to projection, at this camera's own scale. Random "
            "directions are noise; a pattern hints at wrong intrinsics.",
        ),
    )


def _coverage_diagrams(camera: Camera, after: ReprojectionErrors) -> tuple[Diagram, ...]:
    return (
        Diagram(
            "Coverage of the image",
            plots.coverage(camera, after),
            "All frames together. White cells have no matches and constrain nothing.",
        ),
        Diagram(
            "Coverage of distances",
            plots.distances(after),
            "Near points constrain the translation, far ones the rotation: both are needed.",
        ),
    )


def _error_bar_diagrams(result: Calibration, name: str) -> tuple[Diagram, ...]:
    sigmas = result.error_bar(name)
    if sigmas is None:
        return ()
    bootstrap = result.bootstrap.get(name)
    others = None if bootstrap is None else degrees_and_centimetres(bootstrap)
    caption = "One standard deviation, about and along the camera's axes."
    return (Diagram("Error bars", plots.error_bars(sigmas, others), caption),)
