"""The residuals of one camera, as numbers and as a picture without text."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.calibration import Calibration
from calibgraph.report.pictures import data_uri, encode
from calibgraph.solver.matches import camera_blocks
from calibgraph.solver.preprocess import preprocess

if TYPE_CHECKING:
    from calibgraph.model.rig import Camera


# BGR colours that the colour-blind can tell apart (Okabe and Ito, "Color universal design").
_MATCH, _ARROW, _FRAME = (178, 114, 0), (0, 94, 213), (160, 160, 160)

_MAX_DOTS = 6000  # evenly spread; more would overlap
_DOT_SHARE = 0.35  # of the colour of a dot, the rest is white; several dots add up
_WIDTH_PX = 800
_SUBPIXEL_BITS = 4
ARROW_COLUMNS = 12  # cells across the image
_ROUND_FACTORS = np.array([1.0, 2.0, 5.0, 10.0])


def residual_map(camera: Camera, errors: Array, gate_px: float) -> tuple[str, float | None]:
    """The used matches in the image as dots, and the mean residual of each cell as an arrow.

    Args:
        camera: the camera.
        errors: of its matches, see :func:`reprojection_errors`.
        gate_px: tau of the result, within which matches are used.

    Returns:
        A PNG in a data URI; how many times as long as the residuals its arrows are, None if no cell
        has enough matches.
    """
    used, scale = errors[np.hypot(*errors[:, 2:].T) <= gate_px], _WIDTH_PX / camera.width_px
    height = max(1, round(scale * camera.height_px))
    shown = np.linspace(0, len(used) - 1, min(len(used), _MAX_DOTS)).round().astype(int)
    dots = scale * (used[shown, :2] + 0.5)
    column, row = np.clip(dots, 0, np.array([_WIDTH_PX, height]) - 1).astype(int).T
    count = np.zeros((height, _WIDTH_PX), np.float32)
    np.add.at(count, (row, column), 1)
    clear = (1 - _DOT_SHARE) ** cv2.filter2D(count, -1, np.ones((3, 3), np.float32))[..., None]
    image = np.rint(255 * clear + np.array(_MATCH) * (1 - clear)).astype(np.uint8)
    centres, means, cell_px = mean_residuals(camera, used, ARROW_COLUMNS)
    factor = arrow_factor(means, cell_px) if len(means) else None
    starts = scale * (centres + 0.5) - 0.5
    ends = starts + scale * (factor or 0) * means
    for start, end in np.rint(2**_SUBPIXEL_BITS * np.stack([starts, ends], axis=1)).astype(int):
        cv2.arrowedLine(image, start, end, _ARROW, 2, cv2.LINE_AA, _SUBPIXEL_BITS, 0.3)
    cv2.rectangle(image, (0, 0), (_WIDTH_PX - 1, height - 1), _FRAME)
    return data_uri(encode(image, "png")), factor


def arrow_factor(means: Array, cell_px: float) -> float:
    """A round factor by which the longer arrows fill their cells."""
    longest = float(np.quantile(np.hypot(*means.T), 0.9))
    wanted = max(1.0, 0.9 * cell_px / max(longest, 1e-6))
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * _ROUND_FACTORS[wanted / power >= _ROUND_FACTORS].max())


_MIN_PER_CELL = 3  # for a mean


def mean_residuals(camera: Camera, errors: Array, columns: int) -> tuple[Array, Array, float]:
    """The mean residual of each cell that has at least three; the cells are about square.

    Returns:
        (m, 2) centres of these cells [px], (m, 2) their means [px], the width of a cell [px].
    """
    size = np.array([camera.width_px, camera.height_px])
    rows = max(1, round(columns * camera.height_px / camera.width_px))
    u, v = np.clip(errors[:, :2] + 0.5, 0, size).T
    edges = np.linspace(0, size[1], rows + 1), np.linspace(0, size[0], columns + 1)
    counts, *sums = (
        np.histogram2d(v, u, edges, weights=weights)[0] for weights in (None, *errors[:, 2:].T)
    )
    full = np.nonzero(counts >= _MIN_PER_CELL)
    cell = size / [columns, rows]
    centres = (np.column_stack(full[::-1]) + 0.5) * cell - 0.5
    means = np.column_stack([each[full] for each in sums]) / counts[full][:, None]
    return centres, means, float(cell[0])


def reprojection_errors(result: Calibration) -> dict[str, Array]:
    """Per camera (n, 4) of its preprocessed matches that project: pixel, then its error.

    The error is projected less matched, along the directions that the match constrains: for an
    edge, across it. The gate compares its length. Empty without a table.

    Raises:
        CorrespondenceError: if the table does not belong to the result's rig.
    """
    if result.correspondences is None:
        return {}
    # The last of several rounds of matching started near the result, not at the guess.
    start = result.rig if len(result.rounds) > 1 else result.initial_rig
    table = preprocess(start, result.correspondences, result.config).table
    blocks, errors = camera_blocks(result.rig, table, result.config), dict[str, Array]()
    for name in result.residuals.keys() & blocks.keys():
        residuals, valid = blocks[name].block.residuals(result.T_camera_lidar[name][None])
        vectors = constrained(residuals, blocks[name].information)
        errors[name] = np.hstack([blocks[name].block.pixels_px, vectors])[valid]
    return errors


def constrained(residuals: Array, information: Array | None) -> Array:
    """(n, 2) I^(1/2) r / lambda_max^(1/2); its length is the constrained error.

    The root of a 2x2 matrix I is (I + sqrt(det I) E) / sqrt(tr I + 2 sqrt(det I)).
    """
    if information is None:
        return residuals
    uu, uv, vv = information.T
    largest = (uu + vv) / 2 + np.hypot((uu - vv) / 2, uv)
    root = np.sqrt(np.maximum(uu * vv - uv**2, 0.0))
    scale = np.sqrt((uu + vv + 2 * root) * largest)
    x, y = residuals.T
    rooted = np.column_stack([(uu + root) * x + uv * y, uv * x + (vv + root) * y])
    return np.asarray(rooted / scale[:, None])
