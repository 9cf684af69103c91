"""The page's section between cameras: what each pair sees in common, as numbers and a picture."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError
from calibgraph.io.images import load_image
from calibgraph.model.calibration import Calibration
from calibgraph.model.camera_matches import CameraMatches
from calibgraph.model.verdict import Check
from calibgraph.report.page_overlays import Scale, to_gradient, to_jpeg
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


Image = NDArray[np.uint8]

RESIDUAL_LIMIT_PX = 3.0
"""Residual from which lines are red."""

_MAX_LINES = 60  # more hide the images
_MAX_SIDE_PX = 1600
_WIDE = 1.8  # aspect ratio from which images stand above each other
_UNKNOWN = (160, 160, 160)


def draw_matches(images: tuple[Image, ...], pixels_px: Array, errors_px: Array) -> Image:
    """Draw two images and lines between their common features, largest residuals on top.

    Green is no residual, red is RESIDUAL_LIMIT_PX and more, grey is unknown. Every feature has a
    dot; of many, an even selection over the image has a line.

    Args:
        images: (height, width, 3) BGR each.
        pixels_px: (n, 2, 2) the features in both.
        errors_px: (n,) their residuals, or NaN.
    """
    canvas, offset, scale = _put_together(images)
    places = pixels_px + np.array([[0.0, 0.0], offset])
    ends = np.rint((places + 0.5) * scale - 0.5).astype(int)
    order = np.argsort(np.nan_to_num(errors_px, nan=-1.0), kind="stable")
    step = max(1, -(-len(order) // _MAX_LINES))
    across = np.argsort(pixels_px[:, 0, 0], kind="stable")
    lined = np.zeros(len(order), np.bool_)
    lined[across[::step]] = True
    colours = residual_colours(errors_px)
    for row in order:
        colour = tuple(int(c) for c in colours[row])
        if lined[row]:
            start, end = ends[row].tolist()
            cv2.line(canvas, start, end, colour, 1, cv2.LINE_AA)
        for end in ends[row].tolist():
            cv2.circle(canvas, end, 2, colour, -1, cv2.LINE_AA)
    return canvas


def residual_colours(errors_px: Array) -> Image:
    """(n, 3) BGR from green (0) by yellow to red (RESIDUAL_LIMIT_PX); grey where NaN."""
    known = ~np.isnan(errors_px)
    share = np.clip(np.where(known, errors_px, 0.0) / RESIDUAL_LIMIT_PX, 0.0, 1.0)
    red, green = np.minimum(1.0, 2 * share), np.minimum(1.0, 2 * (1 - share))
    colours = np.column_stack([np.zeros_like(share), 220 * green, 255 * red])
    colours[~known] = _UNKNOWN
    return np.asarray(colours, dtype=np.uint8)


def _put_together(images: tuple[Image, ...]) -> tuple[Image, Array, float]:
    """Both images on one canvas, the second's offset before scaling [px], and the scale."""
    (height_a, width_a), (height_b, width_b) = (image.shape[:2] for image in images)
    above = width_a > _WIDE * height_a
    offset = np.array([0, height_a] if above else [width_a, 0])
    size = np.maximum([width_a, height_a], offset + [width_b, height_b])
    canvas = np.zeros((size[1], size[0], 3), np.uint8)
    canvas[:height_a, :width_a] = images[0]
    canvas[offset[1] : offset[1] + height_b, offset[0] : offset[0] + width_b] = images[1]
    scale = min(1.0, _MAX_SIDE_PX / size.max())
    small = cv2.resize(canvas, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(0.7 * small, dtype=np.uint8), offset.astype(np.float64), scale
