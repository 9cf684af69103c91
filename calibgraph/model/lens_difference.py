"""Where two lenses see the same ray."""

from __future__ import annotations

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.rig import Camera
from factors import unproject


def has_other_lens(camera: Camera, other: Camera) -> bool:
    """Whether two lenses differ, or the sizes of their images."""
    one, two = (
        (each.width_px, each.height_px, each.model, each.lens.packed.tolist())
        for each in (camera, other)
    )
    return one != two


def corner_distance_px(camera: Camera, other: Camera) -> float:
    """How far at most two lenses see the ray of a corner of the image apart.

    Infinite where one of them has no such ray, NaN where the images differ in size.
    """
    if (camera.width_px, camera.height_px) != (other.width_px, other.height_px):
        return float("nan")
    apart = lens_difference(camera, other, corners_of(camera))
    return float(np.nan_to_num(np.hypot(*apart.T), nan=np.inf).max())


def lens_difference(camera: Camera, other: Camera, pixels_px: Array) -> Array:
    """How far another lens sees the rays of some pixels from them.

    Args:
        camera: whose pixels these are.
        other: of the same image size.
        pixels_px: (n, 2).

    Returns:
        (n, 2) pixels of the other lens less these; NaN where a lens has no such ray.
    """
    rays, known = unproject(camera.lens, pixels_px)
    seen, valid = other.lens.project(rays)
    known &= valid
    return np.asarray(np.where(known[:, None], other.lens.subtract(seen, pixels_px), np.nan))


def corners_of(camera: Camera) -> Array:
    """(4, 2) the pixels in the corners of the image."""
    right, bottom = camera.width_px - 1.0, camera.height_px - 1.0
    return np.array([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]])
