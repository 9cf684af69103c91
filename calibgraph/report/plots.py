"""The residuals of one camera, as numbers and as a picture without text."""

from __future__ import annotations

import base64
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.calibration import Calibration
from calibgraph.solver.matches import CameraBlock, camera_blocks
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


def residual_map(camera: Camera, errors: ReprojectionErrors) -> tuple[str, float | None]:
    """The used matches in the image as dots, and the mean residual of each cell as an arrow.

    Returns:
        A PNG in a data URI; how many times as long as the residuals its arrows are, None if no cell
        has enough matches.
    """
    inliers, scale = errors.select(errors.is_inlier), _WIDTH_PX / camera.width_px
    height = max(1, round(scale * camera.height_px))
    shown = np.linspace(0, len(inliers.pixels_px) - 1, min(len(inliers.pixels_px), _MAX_DOTS))
    dots = inliers.pixels_px[shown.round().astype(int)]
    column, row = np.clip(scale * (dots + 0.5), 0, np.array([_WIDTH_PX, height]) - 1).astype(int).T
    count = np.zeros((height, _WIDTH_PX), np.float32)
    np.add.at(count, (row, column), 1)
    clear = (1 - _DOT_SHARE) ** cv2.filter2D(count, -1, np.ones((3, 3), np.float32))[..., None]
    image = np.rint(255 * clear + np.array(_MATCH) * (1 - clear)).astype(np.uint8)
    centres, means, cell_px = mean_residuals(camera, inliers, ARROW_COLUMNS)
    factor = arrow_factor(means, cell_px) if len(means) else None
    starts = scale * (centres + 0.5) - 0.5
    ends = starts + scale * (factor or 0) * means
    for start, end in np.rint(2**_SUBPIXEL_BITS * np.stack([starts, ends], axis=1)).astype(int):
        cv2.arrowedLine(image, start, end, _ARROW, 2, cv2.LINE_AA, _SUBPIXEL_BITS, 0.3)
    cv2.rectangle(image, (0, 0), (_WIDTH_PX - 1, height - 1), _FRAME)
    return png_uri(image), factor


def png_uri(image: NDArray[np.uint8]) -> str:
    """A picture, BGR, as a PNG in a data URI."""
    _, data = cv2.imencode(".png", image)
    return f"data:image/png;base64,{base64.b64encode(data.tobytes()).decode('ascii')}"


def arrow_factor(means: Array, cell_px: float) -> float:
    """A round factor by which the longer arrows fill their cells."""
    longest = float(np.quantile(np.hypot(*means.T), 0.9))
    wanted = max(1.0, 0.9 * cell_px / max(longest, 1e-6))
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * _ROUND_FACTORS[wanted / power >= _ROUND_FACTORS].max())


_MIN_PER_CELL = 3  # for a mean


def sum_per_cell(
    pixels_px: Array, camera: Camera, columns: int, values: Array | None = None
) -> Array:
    """(rows, columns) sum of (n,) values of the pixels in each cell, or their number.

    The cells are about square.
    """
    size = camera.width_px, camera.height_px
    rows = max(1, round(columns * size[1] / size[0]))
    u, v = np.clip(pixels_px + 0.5, 0, size).T
    sums = np.histogram2d(v, u, (rows, columns), [(0, size[1]), (0, size[0])], weights=values)[0]
    return np.asarray(sums)


def mean_residuals(
    camera: Camera, errors: ReprojectionErrors, columns: int
) -> tuple[Array, Array, float]:
    """The mean residual of each cell that has at least three.

    Returns:
        (m, 2) centres of these cells [px], (m, 2) their means [px], the width of a cell [px].
    """
    counts = sum_per_cell(errors.pixels_px, camera, columns)
    full = np.nonzero(counts >= _MIN_PER_CELL)
    sums = [sum_per_cell(errors.pixels_px, camera, columns, v)[full] for v in errors.vectors_px.T]
    cell = np.array([camera.width_px / columns, camera.height_px / len(counts)])
    centres = (np.column_stack(full[::-1]) + 0.5) * cell - 0.5
    return centres, np.column_stack(sums) / counts[full][:, None], float(cell[0])


@dataclass(frozen=True, eq=False)
class ReprojectionErrors:
    """The errors of one camera's preprocessed correspondences.

    Attributes:
        pixels_px: (n, 2) matched pixels.
        vectors_px: (n, 2) projected less matched, along the directions that the match constrains:
            for an edge, across it. The gate compares its length.
        gate_px: tau of the result.
    """

    pixels_px: Array
    vectors_px: Array
    gate_px: float

    @property
    def sizes_px(self) -> Array:
        """(n,) lengths of ``vectors_px``."""
        return np.asarray(np.hypot(*self.vectors_px.T))

    @property
    def is_inlier(self) -> NDArray[np.bool_]:
        """(n,) whether the error is within the gate."""
        return np.asarray(self.sizes_px <= self.gate_px)

    def select(self, rows: NDArray[np.bool_]) -> ReprojectionErrors:
        """The errors of some correspondences."""
        return replace(self, pixels_px=self.pixels_px[rows], vectors_px=self.vectors_px[rows])


def reprojection_errors(result: Calibration) -> dict[str, ReprojectionErrors]:
    """The errors of each camera with correspondences; empty without a table.

    Raises:
        CorrespondenceError: if the table does not belong to the result's rig.
    """
    if result.correspondences is None:
        return {}
    # The last of several rounds of matching started near the result, not at the guess.
    start = result.rig if len(result.rounds) > 1 else result.initial_rig
    table = preprocess(start, result.correspondences, result.config).table
    blocks = camera_blocks(result.rig, table, result.config)
    return {
        name: _errors_at(result.T_camera_lidar[name], blocks[name], measured.gate_px)
        for name, measured in result.residuals.items()
        if name in blocks
    }


def _errors_at(T_camera_lidar: Array, matches: CameraBlock, gate_px: float) -> ReprojectionErrors:
    """The errors of those matches that project into the camera at this extrinsic."""
    block = matches.block
    residuals, valid = block.residuals(T_camera_lidar[None])
    everything = ReprojectionErrors(
        pixels_px=block.pixels_px,
        vectors_px=constrained(residuals, matches.information),
        gate_px=gate_px,
    )
    return everything.select(valid)


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
