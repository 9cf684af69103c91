"""What the page shows of a frame: the points that a camera sees, and corners near a pixel."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.matching.structure.visibility import find_in_view, find_visible
from calibgraph.model.rig import Camera

OCCLUSION_SPACINGS = 1.5
"""Side of a cell in which near points hide far ones, in spacings of the points in the image."""
SNAP_RADIUS_PX = 8
"""A corner is looked for so far from the pixel: what a finger or a mouse misses by."""
_CORNER_BLOCK_PX, _CORNER_HALF_PX = 5, 4
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-3)


@dataclass(frozen=True, eq=False)
class VisiblePoints:
    """The points of a cloud that a camera sees: their rows, (k, 2) pixels and distances from it."""

    rows: NDArray[np.intp]
    pixels_px: Array
    distance_m: Array

    def to_bytes(self) -> bytes:
        """Their number and rows (uint32), columns, lines and distances (float32), little-endian."""
        columns = (*self.pixels_px.T, self.distance_m)
        return b"".join(
            [
                np.uint32(len(self.rows)).tobytes(),
                self.rows.astype("<u4").tobytes(),
                *(column.astype("<f4").tobytes() for column in columns),
            ]
        )


def visible_points(points_lidar_m: Array, camera: Camera) -> VisiblePoints:
    """The points in a camera's image that no much nearer point hides."""
    rows, angles, distance_m = find_in_view(points_lidar_m, camera)
    seen = find_visible(angles, distance_m, _cell_rad(angles))
    rows, distance_m = rows[seen], distance_m[seen]
    T = camera.T_camera_lidar
    pixels, _ = camera.lens.project(points_lidar_m[rows] @ T[:3, :3].T + T[:3, 3])
    return VisiblePoints(rows, pixels, distance_m)


def _cell_rad(angles: Array) -> float:
    """OCCLUSION_SPACINGS of points that fill the part of the view in which they lie."""
    if len(angles) < 2:  # noqa: PLR2004 - two make a spacing
        return 1.0
    area = float(np.prod(np.maximum(np.ptp(angles, axis=0), 1e-6)))
    return OCCLUSION_SPACINGS * float(np.sqrt(area / len(angles)))


def snap_to_corner(gray: NDArray[np.uint8], pixel_px: tuple[float, float]) -> Array | None:
    """The strongest corner near a pixel, to a fraction of a pixel.

    Args:
        gray: (height, width).
        pixel_px: (column, row).

    Returns:
        (2,) pixel; None without a corner within SNAP_RADIUS_PX.
    """
    margin = SNAP_RADIUS_PX + _CORNER_BLOCK_PX
    column, row = (round(value) for value in pixel_px)
    left, top = max(column - margin, 0), max(row - margin, 0)
    part = np.ascontiguousarray(gray[top : row + margin + 1, left : column + margin + 1])
    if min(part.shape) <= 2 * _CORNER_BLOCK_PX:
        return None
    strength = cv2.cornerMinEigenVal(part, _CORNER_BLOCK_PX)
    rows, columns = np.indices(part.shape)
    offset = np.hypot(columns + left - pixel_px[0], rows + top - pixel_px[1])
    strength[offset > SNAP_RADIUS_PX] = 0.0
    place = np.unravel_index(int(strength.argmax()), strength.shape)
    if strength[place] <= 0:
        return None
    corner = np.array([[[place[1], place[0]]]], np.float32)
    window = (_CORNER_HALF_PX, _CORNER_HALF_PX)
    found = cv2.cornerSubPix(part, corner, window, (-1, -1), _CRITERIA).reshape(2)
    pixel = found.astype(np.float64) + [left, top]
    return pixel if np.hypot(*(pixel - pixel_px)) <= SNAP_RADIUS_PX else None
