"""Which cameras of a rig can see something in common, by their extrinsics."""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.rig import Camera, Rig

_MARGIN = 0.1  # of an image's size, added on each side: extrinsics are estimates
_POINTS = 5000  # of the cloud: a common strip of a hundredth of all it sees still has 50


def overlapping_pairs(rig: Rig, cloud: NDArray[np.float32]) -> list[tuple[str, str]]:
    """The pairs of cameras that have points of a cloud in both images, or next to them.

    Args:
        rig: lenses and extrinsics.
        cloud: (n, >= 3) x y z [m] in the LiDAR frame.

    Returns:
        A before B in the rig's order.
    """
    step = max(1, len(cloud) // _POINTS)
    points = cloud[::step, :3].astype(np.float64)
    seen = {name: _in_widened_image(camera, points) for name, camera in rig.cameras.items()}
    return [(a, b) for a, b in combinations(rig.cameras, 2) if (seen[a] & seen[b]).any()]


def _in_widened_image(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(n,) the points that project into the image or its margin."""
    T = camera.T_camera_lidar
    pixels, valid = camera.lens.project(points @ T[:3, :3].T + T[:3, 3])
    size = np.array([camera.width_px, camera.height_px])
    shares = (pixels + 0.5) / size
    return np.asarray(valid & (shares > -_MARGIN).all(axis=1) & (shares < 1 + _MARGIN).all(axis=1))
