"""The error model as a factor graph: what matches of a place, and all places, have in common.

Variables, each a ``Pose3`` but b; without errors of sensor and matcher all of a camera are equal:

    x_c   camera c as it is: ``T_lidar_camera``, what is wanted
    b     how the sensor bends the cloud, numbers in standard deviations: a prior by what is usual
          and by the residuals
    m_c   camera c as its matches show it everywhere: tied to x_c and b by ``components.camera``
    n_c   camera c as its pairs show it everywhere: tied to x_c and b by ``components.pairs``
    o     the cloud as displaced everywhere: a prior at the identity, ``components.cloud``
    o_p   the cloud as displaced at place p: tied to o by ``components.cloud_at_place``
    a_cp  camera c as its matches at place p show it: tied to m_c by ``components.at_place``

Correspondences of camera c at place p act on o_p^-1 a_cp, pairs of cameras on o_p^-1 n_a and
o_p^-1 n_b. Priors and measured relative poses act on x_c.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.model.geometry import to_T_lidar_camera
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.camera_pairs import PairTerm
from calibgraph.solver.factor_graph import join
from calibgraph.solver.residual_scale import ResidualScale
from factors import (
    BlockSums,
    PairBlock,
    ProjectionBlock,
    bent_between_factor,
    pair_block_factor,
    placed_pair_factor,
    robust_noise,
)

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Components:
    """Covariances of the latent displacements, positive definite, each in the tangent of its pose.

    Attributes:
        cloud: (6, 6) of the cloud everywhere, in the LiDAR frame.
        cloud_at_place: (6, 6) of the cloud at one place besides.
        camera: (6, 6) of all matches of a camera, in its axes.
        bends: (N, 6, B) by how much they follow one usual standard deviation of each bend.
        pair_bends: (N, 6, B) by how much what pairs show of a camera follows it.
        bend_information: (P, N, B, B) of a camera's residuals at a place about the bends, in units
            of these.
        bend_vector: (P, N, B) the information times the bends that these show.
        bend_weight: (P, N) by which these count.
        bend_size: variance of the bends before, over the usual one.
        pairs: (6, 6) of all that pairs show of a camera.
        at_place: (P, N, 6, 6) of a camera's matches at one place besides.
        robust_scale: distance [sigmas] at which the loss of a place bends (Geman and McClure's);
            infinite: none.
        scatter_at_place: (P, N, 6, 6) the part of ``at_place`` that the scatter of the frames
            shows; 0: none.
    """

    cloud: Array
    cloud_at_place: Array
    camera: Array
    bends: Array
    pair_bends: Array
    bend_information: Array
    bend_vector: Array
    bend_weight: Array
    pairs: Array
    at_place: Array
    bend_size: float = 1.0
    robust_scale: float = np.inf
    scatter_at_place: Array | float = 0.0

    @property
    def all_bends(self) -> Array:
        """(12 N, B) by how much the matches of all cameras, then their pairs, follow the bends."""
        return np.concatenate([*self.bends, *self.pair_bends])

    @property
    def matches_and_pairs(self) -> Array:
        """(12 N, 12 N) of the matches of all cameras, then of their pairs: both share the bends."""
        N = len(self.bends)
        covariance = np.asarray(self.all_bends @ self.bend_covariance @ self.all_bends.T)
        covariance[: 6 * N, : 6 * N] += np.kron(np.eye(N), self.camera)
        covariance[6 * N :, 6 * N :] += np.kron(np.eye(N), self.pairs)
        return covariance

    @cached_property
    def bend_covariance(self) -> Array:
        """(B, B) of the bends, by what is usual and by the residuals."""
        prior = np.eye(self.bends.shape[2]) / self.bend_size
        shown = np.einsum("pn,pnij->ij", self.bend_weight, self.bend_information)
        return np.asarray(np.linalg.inv(prior + shown))

    @cached_property
    def bend_mean(self) -> Array:
        """(B,) of the bends, by the same."""
        shown = np.einsum("pn,pni->i", self.bend_weight, self.bend_vector)
        return np.asarray(self.bend_covariance @ shown)

    @cached_property
    def shared_information(self) -> Array:
        """(6 (2 N + 1),) squared: of the cloud, of all cameras' matches, and of their pairs."""
        whole = np.zeros((6 * (2 * len(self.bends) + 1),) * 2)
        whole[:6, :6] = np.linalg.inv(self.cloud)
        whole[6:, 6:] = np.linalg.inv(self.matches_and_pairs)
        return whole

    @cached_property
    def place_information(self) -> Array:
        """(P, 1 + N, 6, 6) of each place's cloud, then of its cameras."""
        places = len(self.at_place)
        cloud = np.broadcast_to(self.cloud_at_place, (places, 1, 6, 6))
        return np.linalg.inv(np.concatenate([cloud, self.at_place], axis=1))


def place_of(frame: Numbers, places: Sequence[Numbers]) -> Numbers:
    """(n,) the index of the place of each frame number, of places that hold all; else, of another.

    Args:
        frame: (n,).
        places: the frame numbers of each place.
    """
    numbers = np.concatenate(places)
    place = np.repeat(np.arange(len(places)), [len(frames) for frames in places])
    order = np.argsort(numbers)
    nearest = np.searchsorted(numbers, frame, sorter=order)
    found: Numbers = place[order][np.minimum(nearest, len(numbers) - 1)]
    return found


@dataclass(frozen=True, eq=False)
class PlacedBlock:
    """One camera's correspondences, place by place.

    Attributes:
        block: with its loss and scale, sorted by place.
        edges: (P + 1,) where the places begin, and the end.
        place_of_frame: (f,) of the camera's frames, in their own order.
        count_of_frame: (f,) of correspondences.
    """

    block: ProjectionBlock
    edges: Numbers
    place_of_frame: Numbers
    count_of_frame: Numbers

    @staticmethod
    def of(camera: CameraBlock, scale: ResidualScale, places: Sequence[Numbers]) -> PlacedBlock:
        """The correspondences of a camera.

        Args:
            camera: its correspondences.
            scale: of their residuals.
            places: the frame numbers of each place.
        """
        of_frame, counts = place_of(camera.frame_numbers, places), camera.frame_counts
        if len(places) == 1:
            edges = np.array([0, len(camera)])
            return PlacedBlock(camera.with_scale(scale), edges, of_frame, counts)
        edges = np.zeros(len(places) + 1, dtype=np.int64)
        np.add.at(edges[1:], of_frame, counts)
        block = camera.sorted_by(of_frame).with_scale(scale)
        return PlacedBlock(block, edges.cumsum(), of_frame, counts)

    @property
    def frames(self) -> Numbers:
        """(P,) of each place."""
        return np.bincount(self.place_of_frame, minlength=len(self.edges) - 1)

    def with_variance(self, factor: float) -> PlacedBlock:
        """With the variance of its matches multiplied, and the loss bending where it did."""
        root = factor**0.5
        block = self.block.rescale(scale=self.block.scale / root, sigma=self.block.sigma * root)
        return replace(self, block=block)

    def sums(self, T_camera_cloud: Array) -> BlockSums:
        """H, b and c of each place at a pose of its own, (P, 4, 4), stacked."""
        if len(T_camera_cloud) == 1:
            one = self.block.sums(to_T_lidar_camera(T_camera_cloud[0]))
            return BlockSums(one.hessian[None], one.gradient[None], np.array([one.cost]))
        runs = np.column_stack([self.edges[:-1], self.edges[1:]])
        return self.block.run_sums(np.ascontiguousarray(T_camera_cloud), runs)

    def at_place(self, place: int) -> ProjectionBlock:
        """The correspondences of one place."""
        return self.block.select(np.arange(self.edges[place], self.edges[place + 1]))


@dataclass(frozen=True, eq=False)
class PlacedPair:
    """What two cameras see in common, place by place.

    Attributes:
        a, b: their names.
        block: the features, sorted by place.
        places: (r,) of those that have features, in rising order.
        edges: (r + 1,) where each begins in the block, and the end.
    """

    a: str
    b: str
    block: PairBlock
    places: Numbers
    edges: Numbers

    @staticmethod
    def of(term: PairTerm, places: Sequence[Numbers]) -> PlacedPair:
        """The features of a term.

        Args:
            term: with its sigma.
            places: the frame numbers of each place.
        """
        of_row = place_of(term.frame, places)
        rows = np.argsort(of_row, kind="stable")
        found, first = np.unique(of_row[rows], return_index=True)
        edges = np.append(first, len(rows))
        return PlacedPair(term.a, term.b, term.block.select(rows), found, edges)

    def at_each_place(self) -> Iterator[tuple[int, PairBlock]]:
        """The features of each place."""
        for place, first, end in zip(self.places, self.edges[:-1], self.edges[1:], strict=True):
            yield int(place), self.block.select(np.arange(first, end))


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """The data, place by place, and the covariances of what they have in common.

    Attributes:
        cameras: their names.
        blocks: per camera with correspondences.
        pairs: what cameras see in common.
        pose_graph: priors and measured relative poses, on ``x_c``.
        components: of the error.
    """

    cameras: tuple[str, ...]
    blocks: Mapping[str, PlacedBlock]
    pairs: Sequence[PlacedPair]
    pose_graph: gtsam.NonlinearFactorGraph
    components: Components

    @property
    def places(self) -> int:
        """How many there are."""
        return len(self.components.at_place)


def hierarchy_graph(model: Hierarchy) -> gtsam.NonlinearFactorGraph:
    """The whole graph: stock factors between poses, block factors of the data."""
    parts, graph = model.components, gtsam.NonlinearFactorGraph()
    cloud, bend, no_motion = gtsam.symbol("o", 0), gtsam.symbol("b", 0), gtsam.Pose3()
    graph.add(gtsam.PriorFactorPose3(cloud, no_motion, _noise(parts.cloud)))
    of_bends = _noise(parts.bend_covariance)
    graph.add(gtsam.PriorFactorVector(bend, parts.bend_mean, of_bends))
    for place in range(model.places):
        noise = _robust(parts.cloud_at_place, parts.robust_scale)
        graph.add(gtsam.BetweenFactorPose3(cloud, cloud_key(place), no_motion, noise))
    for camera, name in enumerate(model.cameras):
        pose, matched, paired = (gtsam.symbol(letter, camera) for letter in "xmn")
        noise = _noise(parts.camera)
        graph.add(bent_between_factor(pose, bend, matched, parts.bends[camera], noise))
        noise = _noise(parts.pairs)
        graph.add(bent_between_factor(pose, bend, paired, parts.pair_bends[camera], noise))
        for place in range(model.places):
            noise = _robust(parts.at_place[place, camera], parts.robust_scale)
            key = placed_key(model, camera, place)
            graph.add(gtsam.BetweenFactorPose3(matched, key, no_motion, noise))
            if name in model.blocks:
                block = model.blocks[name].at_place(place)
                graph.add(pair_block_factor(cloud_key(place), key, block))
    for pair in model.pairs:
        key_a, key_b = (gtsam.symbol("n", model.cameras.index(n)) for n in (pair.a, pair.b))
        for place, features in pair.at_each_place():
            graph.add(placed_pair_factor(cloud_key(place), key_a, key_b, features))
    return join(graph, model.pose_graph)


def cloud_key(place: int) -> int:
    """Key of ``o_p``."""
    return int(gtsam.symbol("p", place))


def placed_key(model: Hierarchy, camera: int, place: int) -> int:
    """Key of ``a_cp``."""
    return int(gtsam.symbol("a", place * len(model.cameras) + camera))


def _noise(covariance: Array) -> gtsam.noiseModel.Gaussian:
    return gtsam.noiseModel.Gaussian.Covariance(covariance)


def _robust(covariance: Array, scale: float) -> gtsam.noiseModel.Base:
    noise = _noise(covariance)
    return noise if np.isinf(scale) else robust_noise(noise, loss="geman_mcclure", scale=scale)
