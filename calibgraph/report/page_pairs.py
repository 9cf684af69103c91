"""The page's section between cameras: what each pair sees in common, as numbers and a picture."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError
from calibgraph.io.images import load_image
from calibgraph.model.calibration import Calibration
from calibgraph.model.camera_matches import CameraMatches
from calibgraph.model.verdict import Check
from calibgraph.report.page_overlays import Scale, to_gradient, to_jpeg
from calibgraph.report.pair_matches import RESIDUAL_LIMIT_PX, draw_matches, residual_colours
from calibgraph.solver.camera_pairs import match_errors_px

_BYTES = 800_000  # of all pictures together
_STOPS = 17  # of the scale's gradient


@dataclass(frozen=True)
class PairSection:
    """What the template prints of one pair of cameras.

    Attributes:
        name: "A, B".
        matches: features that both see.
        surfaces: those next to a surface of the LiDAR, in either camera.
        frames: with such features.
        median_px: median residual at the result; empty if there is no surface.
        check: whether the pair agrees with the correspondences; None if that was not checked.
        frame: name of the frame in the picture.
        picture: a data URI; empty if an image cannot be read.
    """

    name: str
    matches: int
    surfaces: int
    frames: int
    median_px: str
    check: Check | None
    frame: str
    picture: str


def pair_sections(result: Calibration) -> list[PairSection]:
    """Per pair of cameras that see something in common, in the rig's order."""
    table = result.camera_matches
    if table is None:
        return []
    budget = _BYTES // max(1, len(table.pairs()))
    return [_section(result, table.of_pair(a, b), (a, b), budget) for a, b in table.pairs()]


def match_scale() -> Scale:
    """The colours of the residuals in the pictures."""
    values = np.linspace(0.0, RESIDUAL_LIMIT_PX, _STOPS)
    half = f"{RESIDUAL_LIMIT_PX / 2:g}"
    ticks = ((0.0, "0 px"), (50.0, half), (100.0, f"{RESIDUAL_LIMIT_PX:g} and more"))
    return Scale(to_gradient(residual_colours(values)), ticks)


def _section(
    result: Calibration, rows: CameraMatches, names: tuple[str, str], budget: int
) -> PairSection:
    errors_px = match_errors_px(result.rig, rows)
    known = errors_px[~np.isnan(errors_px)]
    numbers, counts = np.unique(rows.frame, return_counts=True)
    shown = numbers[np.argmax(counts)]
    entry = next((entry for entry in result.frames if entry["frame"] == shown), None)
    of_frame = rows.frame == shown
    matches = rows.pixels_px[of_frame], errors_px[of_frame]
    return PairSection(
        name=", ".join(names),
        matches=len(rows),
        surfaces=len(known),
        frames=len(numbers),
        median_px=f"{np.median(known):.2f}" if len(known) else "",
        check=_check_of(result, names),
        frame=str(entry["name"] if entry else shown),
        picture=_picture(result, names, entry, matches, budget=budget),
    )


def _check_of(result: Calibration, names: tuple[str, str]) -> Check | None:
    """The check of a pair, by its name."""
    checks = result.camera_verdicts[names[0]].checks
    wanted = "relative pose of {} and {} by images".format(*names)
    return next((check for check in checks if check.name == wanted), None)


def _picture(
    result: Calibration,
    names: tuple[str, str],
    entry: Mapping[str, Any] | None,
    matches: tuple[Array, Array],
    *,
    budget: int,
) -> str:
    """A data URI; empty if an image cannot be read, which the overlays report."""
    if entry is None:
        return ""
    try:
        images = tuple(
            load_image(Path(entry["images"][name]), result.rig.cameras[name]) for name in names
        )
    except (CalibrationError, OSError, KeyError):
        return ""
    return to_jpeg(draw_matches(images, *matches), budget)
