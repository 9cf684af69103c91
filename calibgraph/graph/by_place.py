"""The data of the error model, place by place: correspondences, and camera-to-camera matches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from factors import (
    BlockSums,
    Columns,
    PairBlock,
    ProjectionBlock,
    placed_factor,
    to_runs,
)

Numbers = NDArray[np.int64]


def place_of(frame: Numbers, places: Sequence[Numbers]) -> Numbers:
    """(n,) index of each frame's place; of a frame that is in none, any index.

    Args:
        frame: (n,) frame numbers.
        places: the frame numbers of each place.
    """
    numbers = np.concatenate(places)
    place = np.repeat(np.arange(len(places)), [len(frames) for frames in places])
    order = np.argsort(numbers)
    nearest = np.searchsorted(numbers, frame, sorter=order)
    found: Numbers = place[order][np.minimum(nearest, len(numbers) - 1)]
    return found


@dataclass(frozen=True, eq=False)
class BlockByPlace:
    """One camera's correspondences, sorted by place.

    Attributes:
        block: with its loss and scale.
        edges: (P + 1,) first row of each place, and the end.
        place_of_frame: (f,) of the camera's frames, in their own order.
        count_of_frame: (f,) of correspondences.
        free: columns of lens and clock that are estimated; None: none.
    """

    block: ProjectionBlock
    edges: Numbers
    place_of_frame: Numbers
    count_of_frame: Numbers
    free: Columns | None = None

    @property
    def frames(self) -> Numbers:
        """(P,) number of frames of each place."""
        return np.bincount(self.place_of_frame, minlength=len(self.edges) - 1)

    @cached_property
    def places(self) -> Numbers:
        """(p,) the places that have correspondences, in rising order."""
        return np.flatnonzero(np.diff(self.edges))

    def sums(self, T_camera_cloud: Array, values: Array | None = None) -> BlockSums:
        """H, b and c of every place by pose and columns, stacked.

        Args:
            T_camera_cloud: (P, 4, 4) of all places.
            values: (k,) of the columns.
        """
        return self.block.summarize(T_camera_cloud, to_runs(self.edges), self.free, values)

    def factor(self, place: int, keys: Sequence[int]) -> gtsam.NonlinearFactor:
        """The correspondences of one place, lossless, on cloud, camera and columns there."""
        rows = np.arange(*self.edges[place : place + 2])
        return placed_factor(keys, self.block.select(rows), self.free)


@dataclass(frozen=True, eq=False)
class PairByPlace:
    """The matches between two cameras, sorted by place.

    Attributes:
        a: name of the first camera.
        b: name of the second camera.
        block: the features.
        places: (r,) the places that have features, in rising order.
        edges: (r + 1,) first row of every such place, and the end.
    """

    a: str
    b: str
    block: PairBlock
    places: Numbers
    edges: Numbers
