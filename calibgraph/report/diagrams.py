"""One camera's diagrams with their titles and captions."""

from __future__ import annotations

from dataclasses import dataclass

from calibgraph.model.calibration import Calibration, degrees_and_centimetres
from calibgraph.model.rig import Camera
from calibgraph.report import plots
from calibgraph.report.reprojection_errors import BeforeAfter, ReprojectionErrors


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
