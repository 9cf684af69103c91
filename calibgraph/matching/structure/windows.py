"""LiDAR windows: neighbourhoods of rays, with the variation to look for in the image.

A window is a LiDAR point with its nearest rays. Its basis holds how inverse range and intensity
vary over these rays: :mod:`calibgraph.matching.structure.shift_scores` correlates the image with
it. Windows belong to a cloud and a viewpoint: they are cut once, see
:mod:`calibgraph.matching.structure.window_table`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calibgraph.arrays import Array, Mask
from calibgraph.matching.structure.window_kernels import (
    FEATURES,
    describe_windows,
    fill_features,
    make_room,
)
from calibgraph.matching.structure.window_weights import WindowNetwork

Rows = NDArray[np.intp]

WINDOW_POINTS = 25  # samples of a window; fewer cannot hold an edge and both its sides
MIN_WINDOW_POINTS = 9
WINDOW_STRETCH = 4.0  # longest window by the radius of an even one: room for single scan lines
MIN_WEIGHT = 0.1  # of a window that counts where windows are weighed
MIN_SPACING_RAD = np.radians(0.15)  # few sensors sample more finely along their scan lines


@dataclass(frozen=True, eq=False)
class Windows:
    """Correlation windows of one cloud.

    Attributes:
        rays_m: (w, WINDOW_POINTS, 3) from the viewpoint, along the axes of the LiDAR frame, to
            the points, the window's centre first. Points behind a silhouette are moved along
            their rays to its distance, which determines where the silhouette is in the image.
        members: (w, WINDOW_POINTS) the same points, as rows of their table's rays.
        front: (w, WINDOW_POINTS) which of them are not behind a silhouette.
        counts: (w,) how many of the members are in use: the first ones.
        basis: (w, WINDOW_POINTS, 4) columns: inverse range and intensity (orthonormal, shrunk where
            they are flat), and the two linear functions of direction; these are zero where a
            window keeps its linear parts.
        features: (w, f) what its weight depends on, see ``FEATURES``; zeros where a window does
            not keep its linear parts.
        weight: (w,) how much a window tells where it is, 0 to 1; 1 until it is weighed.
    """

    rays_m: NDArray[np.float32]
    members: NDArray[np.int32]
    front: Mask
    counts: NDArray[np.int32]
    basis: NDArray[np.float32]
    features: NDArray[np.float32]
    weight: NDArray[np.float32]

    @staticmethod
    def empty(count: int, make: Callable[..., NDArray[Any]] = np.empty) -> Windows:
        """Room for so many windows, in arrays that are made from their shapes and dtypes."""
        shape = (count, WINDOW_POINTS)
        return Windows(
            rays_m=make((*shape, 3), np.float32),
            members=make(shape, np.int32),
            front=make(shape, np.bool_),
            counts=make((count,), np.int32),
            basis=make((*shape, 4), np.float32),
            features=make((count, len(FEATURES)), np.float32),
            weight=make((count,), np.float32),
        )

    def select(self, rows: Mask | Rows) -> Windows:
        """Some of the windows."""
        rows = np.flatnonzero(rows) if rows.dtype == np.bool_ else rows
        return Windows(**{name: values.take(rows, axis=0) for name, values in vars(self).items()})

    def weighed(self, network: WindowNetwork) -> Windows:
        """Those that tell something, with the shares of variation they explain times the weights.

        What is left out, a fifth of all, changes no z-score by more than a fiftieth.
        """
        weight = network.weights(self.features)
        kept = replace(self, weight=weight).select(weight > MIN_WEIGHT)
        return replace(kept, basis=kept.basis * np.sqrt(kept.weight)[:, None, None])

    def put(self, first: int, others: Windows) -> None:
        """Write others in place of the windows from a row on."""
        for name, values in vars(others).items():
            getattr(self, name)[first : first + len(values)] = values

    @property
    def nbytes(self) -> int:
        """Size in memory."""
        return sum(values.nbytes for values in vars(self).values())


def cut_windows(
    cloud: tuple[Array, Array],
    centres: NDArray[np.int32],
    thinned: tuple[cKDTree, NDArray[np.int32]],
    *,
    spacing_rad: float,
    keep_linear: bool,
) -> tuple[Windows, Array]:
    """Cut windows of the nearest rays.

    Args:
        cloud: (n, 3) rays from the viewpoint to the points, along the axes of the LiDAR frame
            [m]; (n,) their intensity ranks.
        centres: (w,) of the thinned rays, those that are the windows' centres.
        thinned: the directions of (m,) rays, as unit vectors, and their rows of the cloud.
        spacing_rad: of these.
        keep_linear: keep the linear parts of the variation, and describe it.

    Returns:
        The windows; (w,) how reliably each can be seen in an image: 0 where it is too small or
        flat, 1 where much varies.
    """
    windows, reliability = Windows.empty(len(centres)), np.zeros(len(centres))
    even = math.sqrt(WINDOW_POINTS / math.pi) * max(spacing_rad, MIN_SPACING_RAD)
    reach = 2 * math.sin(WINDOW_STRETCH * even / 2)  # as a chord
    tree, rows = thinned
    _, nearest = tree.query(tree.data[centres], WINDOW_POINTS, distance_upper_bound=reach)
    near = nearest < tree.n  # fewer are within reach
    windows.counts[:] = near.sum(axis=1)
    windows.members[:] = rows[np.where(near, nearest, centres[:, None])]
    room = make_room(WINDOW_POINTS)
    describe_windows(
        cloud, windows.members, windows.counts, keep_linear, room,
        windows.rays_m, windows.front, windows.basis, reliability,
    )  # fmt: skip
    reliability[windows.counts < MIN_WINDOW_POINTS] = 0.0
    windows.weight[:], windows.features[:] = 1.0, 0.0
    if keep_linear:
        fill_features(
            cloud, windows.members, windows.counts, room,
            windows.front, windows.basis, windows.features,
        )  # fmt: skip
    return windows, reliability
