"""Lenses as a target's calibration states them, which is not quite as they are."""

import gtsam
import numpy as np
from scipy.optimize import least_squares

from calibgraph.arrays import Array
from calibgraph.model.rig import Camera, Intrinsics, Rig
from calibgraph.simulation.cameras import pixel_directions

_FOCAL, _ASPECT, _CENTRE, _CORNER = 1e-3, 2e-4, 5e-4, 3e-4
_GRID_PX, _DEPTHS_M = (16, 12), (5.0, 10.0, 20.0, 40.0)
_RADIAL = {"pinhole": 0, "fisheye": 0, "omnidirectional": 1}  # where k1 stands


def draw_lens_errors(rig: Rig, size: float, rng: np.random.Generator) -> Rig:
    """The rig as its owner knows it: lenses that are off, and the extrinsics that fit them best.

    At size 1 as a good calibration with a target (40 views, corners to 0.2 px, leave a focal length
    0.1 to 0.2 % and a principal point 0.1 % of the width uncertain): focal lengths wrong by 0.1 %
    both, by 0.02 % one alone, principal points by 0.05 % of the image's width, and radial
    distortion by 0.03 % of it at the corners (standard deviations).

    Returns:
        The rig with other lenses. Its extrinsics are those with which they project, over the whole
        image and 5 to 40 m away, nearest to where the true cameras see.
    """
    return rig.model_copy(
        update={"cameras": {n: _as_stated(c, size, rng) for n, c in rig.cameras.items()}}
    )


def _as_stated(camera: Camera, size: float, rng: np.random.Generator) -> Camera:
    focal, aspect, right, down, corner = size * rng.standard_normal(5)
    if camera.model not in _RADIAL or not size:
        return camera
    k, width = camera.intrinsics_px, camera.width_px
    lens = Intrinsics(
        fx=k.fx * (1 + _FOCAL * focal),
        fy=k.fy * (1 + _FOCAL * focal + _ASPECT * aspect),
        cx=k.cx + _CENTRE * width * right,
        cy=k.cy + _CENTRE * width * down,
    )
    radius = np.hypot(camera.width_px, camera.height_px) / 2 / k.fx
    distortion = np.pad(camera.distortion, (0, max(0, 4 - len(camera.distortion))))
    distortion[_RADIAL[camera.model]] += _CORNER * width * corner / (k.fx * radius**3)
    stated = camera.model_copy(
        update={"intrinsics_px": lens, "distortion": tuple(distortion.tolist())}
    )
    return stated.moved_to(_nearest(stated, camera))


def _nearest(stated: Camera, camera: Camera) -> Array:
    """(4, 4) T_camera_lidar with which the stated lens projects as the true camera does."""
    sides = zip((camera.width_px, camera.height_px), _GRID_PX, strict=True)
    grid = np.meshgrid(*(np.linspace(0, side - 1, count) for side, count in sides))
    pixels_px = np.stack(grid, axis=-1).reshape(-1, 2)
    directions = pixel_directions(camera, pixels_px)
    seen = directions.any(axis=1)
    points = np.concatenate([depth * directions[seen] for depth in _DEPTHS_M])
    targets_px = np.tile(pixels_px[seen], (len(_DEPTHS_M), 1))

    def missed_px(twist: Array) -> Array:
        T = gtsam.Pose3.Expmap(twist).matrix()
        projected, valid = stated.lens.project(points @ T[:3, :3].T + T[:3, 3])
        return np.where(valid[:, None], projected - targets_px, 0.0).ravel()

    twist = least_squares(missed_px, np.zeros(6), x_scale=1e-3).x
    return np.asarray(gtsam.Pose3.Expmap(twist).matrix() @ camera.T_camera_lidar)
