"""LiDAR windows: neighbourhoods of rays, with the variation to look for in the image.

A window is a LiDAR point with its nearest rays. Its basis holds how inverse range and intensity
vary over these rays: :mod:`calibgraph.matching.structure.shift_scores` correlates the image with
it. Windows belong to a cloud and a viewpoint: they are cut once, see
:mod:`calibgraph.matching.structure.window_table`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calibgraph.matching.structure.window_kernel import describe_windows

Array = NDArray[np.float64]
Rows = NDArray[np.intp]
Mask = NDArray[np.bool_]

WINDOW_POINTS = 25  # samples of a window; fewer cannot hold an edge and both its sides
MIN_WINDOW_POINTS = 9
WINDOW_STRETCH = 4.0  # longest window by the radius of an even one: room for single scan lines
MIN_SPACING_RAD = np.radians(0.15)  # few sensors sample more finely along their scan lines


@dataclass(frozen=True, eq=False)
class Windows:
    """Correlation windows of one cloud.

    Attributes:
        rays_m: (w, WINDOW_POINTS, 3) from the viewpoint, along the axes of the LiDAR frame, to
            the points, the window's centre first. Points behind a silhouette are moved along
            their rays to its distance, which determines where the silhouette is in the image.
        members: (w, WINDOW_POINTS) the same points, as indices into those that were given.
        front: (w, WINDOW_POINTS) which of them are not behind a silhouette.
        counts: (w,) how many of the members are in use: the first ones.
        basis: (w, WINDOW_POINTS, 4) columns: inverse range and intensity (orthonormal, shrunk where
            they are flat), and the two linear functions of direction; these are zero where a
            window keeps its linear parts.
    """

    rays_m: NDArray[np.float32]
    members: NDArray[np.int32]
    front: Mask
    counts: NDArray[np.int32]
    basis: NDArray[np.float32]

    @staticmethod
    def empty(count: int = 0) -> Windows:
        """Room for so many windows."""
        shape = (count, WINDOW_POINTS)
        return Windows(
            rays_m=np.empty((*shape, 3), np.float32),
            members=np.empty(shape, np.int32),
            front=np.empty(shape, np.bool_),
            counts=np.empty(count, np.int32),
            basis=np.empty((*shape, 4), np.float32),
        )

    def select(self, rows: Mask | Rows) -> Windows:
        """Some of the windows."""
        return Windows(**{name: values[rows] for name, values in vars(self).items()})

    def join(self, others: Windows) -> Windows:
        """These windows, then others."""
        pairs = {name: (values, getattr(others, name)) for name, values in vars(self).items()}
        return Windows(**{name: np.concatenate(pair) for name, pair in pairs.items()})

    @property
    def nbytes(self) -> int:
        """Size in memory."""
        return sum(values.nbytes for values in vars(self).values())


def cut_windows(
    cloud: tuple[Array, Array], centres: Rows, neighbours: Neighbours, *, keep_linear: bool
) -> tuple[Windows, Array]:
    """Cut windows of the nearest rays.

    Args:
        cloud: (n, 3) rays from the viewpoint to thinned points, along the axes of the LiDAR
            frame [m]; (n,) their intensity ranks.
        centres: (w,) rows of the windows' centres.
        neighbours: of the rays.
        keep_linear: keep the linear parts of the variation.

    Returns:
        The windows; (w,) how reliably each can be seen in an image: 0 where it is too small or
        flat, 1 where much varies.
    """
    windows, reliability = Windows.empty(len(centres)), np.zeros(len(centres))
    windows.members[:], windows.counts[:] = neighbours.of(centres)
    describe_windows(
        cloud, windows.members, windows.counts, keep_linear,
        windows.rays_m, windows.front, windows.basis, reliability,
    )  # fmt: skip
    reliability[windows.counts < MIN_WINDOW_POINTS] = 0.0
    return windows, reliability


class Neighbours:
    """The nearest rays of any ray.

    Args:
        directions: (n, 3) unit vectors.
        spacing_rad: of the rays.
    """

    def __init__(self, directions: Array, spacing_rad: float) -> None:
        self._tree = cKDTree(directions, balanced_tree=False)
        even = math.sqrt(WINDOW_POINTS / math.pi) * max(spacing_rad, MIN_SPACING_RAD)
        self._reach = 2 * math.sin(WINDOW_STRETCH * even / 2)  # as a chord

    def of(self, centres: Rows) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """(w, WINDOW_POINTS) rows, the centre first and in place of missing ones; (w,) how many."""
        _, rows = self._tree.query(
            self._tree.data[centres], WINDOW_POINTS, distance_upper_bound=self._reach
        )
        found = rows < self._tree.n
        return np.where(found, rows, centres[:, None]).astype(np.int32), found.sum(axis=1)
