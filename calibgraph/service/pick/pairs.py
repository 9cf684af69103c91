"""Picked pairs: a pixel of an image and a point of the cloud of the same frame."""

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from calibgraph.arrays import Array
from calibgraph.model.correspondences import MAX_COORDINATE, Correspondences

Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE, le=MAX_COORDINATE, allow_inf_nan=False)]

PICK_SIGMA_PX = 1.0
"""Standard deviation of a pixel picked with the loupe, per axis, unless it is given."""


class Pair(BaseModel):
    """A pixel and the LiDAR point that it shows.

    Attributes:
        frame: number of the frame in the dataset.
        camera: name.
        pixel_px: (column, row) in the image as recorded.
        point_index: row of the point in the frame's cloud.
        sigma_px: standard deviation of the pixel per axis.
        used: whether it takes part in the estimate.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    frame: Annotated[int, Field(ge=0, lt=2**31)]
    camera: Annotated[str, Field(max_length=100)]
    pixel_px: tuple[Coordinate, Coordinate]
    point_index: Annotated[int, Field(ge=0, lt=2**31)]
    point_lidar_m: tuple[Coordinate, Coordinate, Coordinate]
    sigma_px: Annotated[float, Field(ge=0.05, le=100, allow_inf_nan=False)] = PICK_SIGMA_PX
    used: bool = True


def pixels_of(pairs: Sequence[Pair]) -> Array:
    """(n, 2) pixels."""
    return np.array([pair.pixel_px for pair in pairs], dtype=np.float64).reshape(-1, 2)


def points_of(pairs: Sequence[Pair]) -> Array:
    """(n, 3) points in the LiDAR frame."""
    return np.array([pair.point_lidar_m for pair in pairs], dtype=np.float64).reshape(-1, 3)


def sigmas_of(pairs: Sequence[Pair]) -> Array:
    """(n,) standard deviations of the pixels."""
    return np.array([pair.sigma_px for pair in pairs], dtype=np.float64)


def to_table(pairs: Sequence[Pair]) -> Correspondences:
    """The used pairs as a table of correspondences; the information is 1 / sigma^2."""
    used = [pair for pair in pairs if pair.used]
    weight = sigmas_of(used) ** -2
    return Correspondences.from_arrays(
        camera=np.array([pair.camera for pair in used], dtype=np.str_),
        frame=np.array([pair.frame for pair in used], dtype=np.int64),
        pixels_px=pixels_of(used),
        points_lidar_m=points_of(used),
        information_px=np.column_stack([weight, np.zeros_like(weight), weight]),
        point_index=np.array([pair.point_index for pair in used], dtype=np.int64),
        metadata={"name": "pick"},
    )
