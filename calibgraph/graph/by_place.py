"""The data of the error model, place by place: correspondences, and camera-to-camera matches."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.geometry import to_T_lidar_camera
from factors import (
    BlockSums,
    PairBlock,
    ProjectionBlock,
    pair_block_factor,
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
    """

    block: ProjectionBlock
    edges: Numbers
    place_of_frame: Numbers
    count_of_frame: Numbers

    @property
    def frames(self) -> Numbers:
        """(P,) number of frames of each place."""
        return np.bincount(self.place_of_frame, minlength=len(self.edges) - 1)

    @cached_property
    def places(self) -> Numbers:
        """(p,) the places that have correspondences, in rising order."""
        return np.flatnonzero(np.diff(self.edges))

    def with_variance(self, factor: float) -> BlockByPlace:
        """Multiply the variance of the matches; the loss keeps its tuning constant in pixels."""
        root = factor**0.5
        block = self.block.rescale(scale=self.block.scale / root, sigma=self.block.sigma * root)
        return replace(self, block=block)

    def sums(self, T_camera_cloud: Array) -> BlockSums:
        """H, b and c of every place at a pose of its own, (P, 4, 4), stacked."""
        if len(T_camera_cloud) == 1:
            one = self.block.sums(to_T_lidar_camera(T_camera_cloud[0]))
            return BlockSums(one.hessian[None], one.gradient[None], np.array([one.cost]))
        runs = np.column_stack([self.edges[:-1], self.edges[1:]])
        return self.block.run_sums(np.ascontiguousarray(T_camera_cloud), runs)

    def factors(self, place: int, cloud: int, matched: int) -> list[gtsam.NonlinearFactor]:
        """The correspondences of one place, lossless, on the variables of these keys."""
        first, end = self.edges[place : place + 2].tolist()
        whole = end - first == len(self.block)
        block = self.block if whole else self.block.select(np.arange(first, end))
        return [pair_block_factor(cloud, matched, block)] if first < end else []


@dataclass(frozen=True, eq=False)
class QuadraticByPlace:
    """One camera's correspondences whose sums alone are kept: a quadratic per place.

    Attributes:
        places: (p,) the places that have correspondences, in rising order.
        T_lidar_camera: per such place, the minimum.
        information: (p, 6, 6) in the tangent there, positive definite.
    """

    places: Numbers
    T_lidar_camera: Sequence[gtsam.Pose3]
    information: Array

    def sums(self, T_camera_cloud: Array) -> BlockSums:
        """H, b and c of every place at a pose of its own, (P, 4, 4), stacked."""
        count = len(T_camera_cloud)
        found = BlockSums(np.zeros((count, 6, 6)), np.zeros((count, 6)), np.zeros(count))
        for row, place in enumerate(self.places.tolist()):
            T_lidar_camera = to_T_lidar_camera(T_camera_cloud[place])
            step = self.T_lidar_camera[row].localCoordinates(T_lidar_camera)
            found.hessian[place] = self.information[row]
            found.gradient[place] = found.hessian[place] @ step
            found.cost[place] = step @ found.gradient[place]
        return found

    def factors(self, place: int, cloud: int, matched: int) -> list[gtsam.NonlinearFactor]:
        """The quadratic of one place, a stock factor on the variables of these keys."""
        noise = gtsam.noiseModel.Gaussian.Information
        return [
            gtsam.BetweenFactorPose3(
                cloud, matched, self.T_lidar_camera[row], noise(self.information[row])
            )
            for row in np.flatnonzero(self.places == place).tolist()
        ]


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

    def at_each_place(self) -> Iterator[tuple[int, PairBlock]]:
        """Every place with its features."""
        for place, first, end in zip(self.places, self.edges[:-1], self.edges[1:], strict=True):
            yield int(place), self.block.select(np.arange(first, end))
