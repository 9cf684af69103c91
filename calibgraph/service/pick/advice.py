"""What to pick next: the part of the image whose points reduce the largest uncertainty most."""

from dataclasses import dataclass

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.rig import Camera
from calibgraph.service.pick.session import PICK_SIGMA_PX
from calibgraph.solver.camera_twist import project_with_jacobian

TOLERABLE: Array = np.repeat([np.radians(0.15), 0.05], 3)
"""Errors of rotation [rad] and translation [m] that weigh alike: 0.15 deg, 5 cm."""
TOLERABLE.setflags(write=False)

_CELLS = 3
_COLUMNS, _ROWS = ("left", "middle", "right"), ("upper", "middle", "lower")
_NEAR_M, _FAR_M = 8.0, 20.0
_MOST = 3000  # candidates, evenly over the cloud
_TYPICAL = 0.75  # quantile of a cell's points: one of the better ones can be found by the eye


@dataclass(frozen=True)
class Advice:
    """The part of an image in which to pick next.

    Attributes:
        words: such as "pick something in the left third".
        column, row: of the part, 0 to 2.
        keeps: share of the weakest direction's standard deviation that is left after one pair.
    """

    words: str
    column: int
    row: int
    keeps: float


def advise(
    camera: Camera, covariance: Array, scale: float, *, points_lidar_m: Array, pixels_px: Array
) -> Advice | None:
    """Where one more pair reduces the weakest direction most; None if there is nothing to pick.

    Args:
        camera: at the estimate.
        covariance: (6, 6) of its extrinsic.
        scale: measured over stated standard deviation of pixels.
        points_lidar_m: (n, 3) that the camera sees.
        pixels_px: (n, 2) theirs.
    """
    if not len(points_lidar_m):
        return None
    step = slice(None, None, -(-len(points_lidar_m) // _MOST))
    points, pixels = points_lidar_m[step], pixels_px[step]
    kept = _share_left(camera, covariance, scale, points)
    T = camera.T_camera_lidar
    distance = np.linalg.norm(points @ T[:3, :3].T + T[:3, 3], axis=1)
    band = np.digitize(distance, [_NEAR_M, _FAR_M])
    size = np.array([camera.width_px, camera.height_px])
    places = np.clip(_CELLS * (pixels + 0.5) / size, 0, _CELLS - 1e-9).astype(np.int64)
    cell = (places[:, 1] * _CELLS + places[:, 0]) * _CELLS + band
    best, share = min(
        ((int(c), float(np.quantile(kept[cell == c], 1 - _TYPICAL))) for c in np.unique(cell)),
        key=lambda found: found[1],
    )
    row, column = divmod(best // _CELLS, _CELLS)
    return Advice(_words(column, row, best % _CELLS, share), column, row, share)


def _share_left(camera: Camera, covariance: Array, scale: float, points_m: Array) -> Array:
    """(n,) standard deviation along the weakest direction with one more pair, over that without."""
    values, vectors = np.linalg.eigh(covariance / np.outer(TOLERABLE, TOLERABLE))
    weak = vectors[:, -1] * np.sqrt(values[-1])  # C' w = lambda w, in tolerable units
    J = project_with_jacobian(camera, points_m)[1] * TOLERABLE / (scale * PICK_SIGMA_PX)
    scaled = covariance / np.outer(TOLERABLE, TOLERABLE)
    # w^T (C - C J^T (I + J C J^T)^-1 J C) w over w^T C w, for the unit eigenvector of C.
    along = J @ weak
    inner = np.eye(2) + J @ scaled @ J.transpose(0, 2, 1)
    drop = np.einsum("ni,ni->n", along, np.linalg.solve(inner, along[:, :, None])[:, :, 0])
    share: Array = np.sqrt(np.clip(1.0 - drop, 0.0, 1.0))
    return share


def _words(column: int, row: int, band: int, share: float) -> str:
    where = f"the {_COLUMNS[column]} third"
    if row != 1:
        where += f", {_ROWS[row]} part"
    how_far = (f", nearer than {_NEAR_M:g} m", "", f", farther than {_FAR_M:g} m")[band]
    return f"pick something in {where}{how_far}: one pair leaves {share:.0%} of that error bar"
