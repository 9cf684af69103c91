"""The error model as a factor graph: errors that the data of one place, or of all places, share.

    prior         o at the identity, d at zero, each by its variance components
    distortion    d by the residuals of the matches, which no pose can follow
    camera        x_c to m_c, displaced by the scan distortion d as matches see it; x_c to n_c,
                  as pairs see it
    alignment     x_c to y_c, displaced as m_c, exactly; in the graph that is printed
    place         o to o_p, and m_c to a_cp, with a robust loss
    data          correspondences of camera c at place p, on o_p and a_cp;
                  camera-to-camera matches at place p, on o_p, n_a and n_b
    pose graph    priors and measured relative poses, on x_c
    lens          l_c, s_c where lenses are estimated: ``calibgraph.graph.lens``

What is reported is y_c, the alignment: the pose that puts the points, as this sensor delivers them,
on this camera's image. The mount x_c is where the sensor is; what is unknown of its beams is added.
Images show relative poses of cameras without the cloud, so these are of mounts. What may err of
lens and clock, and is not estimated, is considered: it widens what is reported.

The names are those of ``calibgraph.graph.variables``. Without errors of sensor and matcher all
poses of a camera are equal, and the graph is that of Eq. 5 of the paper.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.graph.components import EXACT, VarianceComponents
from calibgraph.graph.lens import LensTerm, lens_graph
from calibgraph.graph.objective import join
from calibgraph.graph.variables import (
    CLOUD,
    DISTORTION,
    aligned_key,
    camera_key,
    cloud_at_key,
    lens_key,
    matched_at_key,
    matched_key,
    paired_key,
    seen_lens_key,
)
from calibgraph.model.config import Reported
from calibgraph.model.geometry import adjoints, retract_all
from factors import (
    BlockSums,
    Columns,
    PairBlock,
    ProjectionBlock,
    displaced_between_factor,
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
        numbers: of both cameras.
        block: the features.
        places: (r,) the places that have features, in rising order.
        edges: (r + 1,) first row of every such place, and the end.
    """

    numbers: tuple[int, int]
    block: PairBlock
    places: Numbers
    edges: Numbers

    @property
    def keys(self) -> list[int]:
        """Of ``n_a`` and ``n_b``."""
        return [*map(paired_key, self.numbers)]


@dataclass(frozen=True, eq=False)
class LatentPoseModel:
    """Data, priors and variance components: everything that the graph is made of.

    Attributes:
        cameras: their names.
        blocks: correspondences, per camera that has some.
        pairs: camera-to-camera matches.
        pose_graph: priors and measured relative poses, on ``x_c``; marginals of places that are
            not in the graph, on ``o`` and ``m_c``.
        components: of the errors.
        of: the poses that are reported.
        lenses: those that are estimated, by the numbers of their cameras.
        considered: (6 N, 6 N) covariance of what is reported by what is considered of lens and
            clock.
        frames: the numbers of the frames of each place.
    """

    cameras: tuple[str, ...]
    blocks: Mapping[str, BlockByPlace]
    pairs: Sequence[PairByPlace]
    pose_graph: gtsam.NonlinearFactorGraph
    components: VarianceComponents
    of: Reported = "alignment"
    lenses: Mapping[int, LensTerm] = field(default_factory=dict)
    considered: Array = field(default_factory=lambda: np.zeros((0, 0)))
    frames: Sequence[NDArray[np.int64]] = ()

    @property
    def places(self) -> int:
        """Number of places."""
        return len(self.components.at_place)

    @property
    def camera_keys(self) -> list[int]:
        """Keys of ``x_c``."""
        return [camera_key(number) for number in range(len(self.cameras))]

    @cached_property
    def alignment(self) -> Array:
        """(N, 6, B) displacement of alignments from mounts by ``d``; of unmatched, as of pairs."""
        found = self.components.pair_distortion_jacobian.copy()
        found[self.matched] = self.components.distortion_jacobian[self.matched]
        return found

    def reported(self, values: gtsam.Values, of: Reported) -> tuple[Array, Array]:
        """(N, 4, 4) T_camera_lidar of mounts or alignments; (6 N, n) derivative by all columns."""
        mounts = [values.atPose3(key).inverse().matrix() for key in self.camera_keys]
        T, rows = np.array(mounts), np.zeros((len(mounts), 6, self.size))
        at = self.columns_of(self.camera_keys).reshape(-1, 1, 6)
        own = np.arange(len(mounts))[:, None, None], np.arange(6)[:, None], at
        rows[own] = np.eye(6)
        if of == "alignment" and self.is_distorted:
            away = self.alignment @ values.atVector(DISTORTION)
            rows[own] = adjoints(retract_all(np.tile(np.eye(4), (len(T), 1, 1)), away))
            rows[..., self.columns[DISTORTION]] = right_jacobians(away) @ self.alignment
            T = retract_all(T, away)
        return T, rows.reshape(-1, self.size)

    def lens_keys(self, number: int) -> list[int]:
        """Key of ``s_c``, if the lens of the camera is estimated."""
        return [seen_lens_key(number)] if number in self.lenses else []

    @cached_property
    def matched(self) -> list[int]:
        """Numbers of the cameras that have correspondences."""
        return [number for number, name in enumerate(self.cameras) if name in self.blocks]

    @cached_property
    def paired(self) -> list[int]:
        """Numbers of the cameras that are part of a pair."""
        return sorted({number for pair in self.pairs for number in pair.numbers})

    @cached_property
    def is_distorted(self) -> bool:
        """Whether the scan distortion is a variable."""
        parts = self.components
        return bool(parts.distortion_jacobian.any() or parts.pair_distortion_jacobian.any())

    @cached_property
    def present(self) -> NDArray[np.bool_]:
        """(M, P) where a matched camera has data."""
        found = np.zeros((len(self.matched), self.places), dtype=np.bool_)
        for row, number in enumerate(self.matched):
            found[row, self.blocks[self.cameras[number]].places] = True
        return found

    @property
    def matched_places(self) -> list[tuple[int, int]]:
        """Place and camera of every ``a_cp``."""
        return [(place, self.matched[row]) for row, place in np.argwhere(self.present).tolist()]

    @cached_property
    def shared_graph(self) -> gtsam.NonlinearFactorGraph:
        """The factors of what all places share: of errors, pose graph, lenses."""
        lenses = lens_graph(self.lenses, is_distorted=self.is_distorted)
        return join(self.error_graph, self.pose_graph, lenses)

    @cached_property
    def error_graph(self) -> gtsam.NonlinearFactorGraph:
        """Those of the errors that have variance components: cloud, distortion, camera, pairs."""
        parts, graph = self.components, gtsam.NonlinearFactorGraph()
        graph.add(gtsam.PriorFactorPose3(CLOUD, gtsam.Pose3(), _noise(parts.cloud)))
        if self.is_distorted:
            graph.push_back(_distortion_graph(parts))
        for number in self.matched:
            shifts = {DISTORTION: self.alignment[number]} if self.is_distorted else {}
            if (term := self.lenses.get(number)) is not None:
                shifts = term.displace(number, shifts)
            graph.add(_tie(camera_key(number), matched_key(number), shifts, parts.camera))
        for number in self.paired:
            seen = parts.pair_distortion_jacobian[number]
            shifts = {DISTORTION: seen} if self.is_distorted else {}
            graph.add(_tie(camera_key(number), paired_key(number), shifts, parts.pairs))
        return graph

    @cached_property
    def place_graph(self) -> gtsam.NonlinearFactorGraph:
        """Those between what all places share and each place: o to o_p, and m_c to a_cp."""
        parts, graph, no_motion = self.components, gtsam.NonlinearFactorGraph(), gtsam.Pose3()
        clouds = np.broadcast_to(parts.cloud_at_place, (self.places, 6, 6))
        for place, covariance in enumerate(clouds):
            noise = _robust(covariance, parts.robust_scale)
            graph.add(gtsam.BetweenFactorPose3(CLOUD, cloud_at_key(place), no_motion, noise))
        for place, camera in self.matched_places:
            noise = _robust(parts.at_place[place, camera], parts.robust_scale)
            keys = matched_key(camera), matched_at_key(place, camera)
            graph.add(gtsam.BetweenFactorPose3(*keys, no_motion, noise))
        return graph

    @property
    def tied_keys(self) -> list[int]:
        """Keys of ``o`` and every ``m_c``."""
        return [CLOUD, *map(matched_key, self.matched)]

    @cached_property
    def columns(self) -> dict[int, NDArray[np.intp]]:
        """By key of a shared variable, its columns; first those that factors of places have."""
        sizes = dict.fromkeys([*self.tied_keys, *map(paired_key, self.paired)], 6)
        for key in (seen_lens_key, lens_key):
            sizes |= {key(n): len(term.variable.free) for n, term in self.lenses.items()}
        if self.is_distorted:
            sizes[DISTORTION] = self.components.distortion_jacobian.shape[2]
        sizes |= dict.fromkeys(self.camera_keys, 6)
        ends = np.cumsum([*sizes.values()]).tolist()
        return {key: np.arange(end - sizes[key], end) for key, end in zip(sizes, ends, strict=True)}

    def columns_of(self, keys: Iterable[int]) -> NDArray[np.intp]:
        """The columns of some shared variables."""
        return np.concatenate([self.columns[key] for key in keys])

    @property
    def size(self) -> int:
        """Number of these columns; those of the mounts are the last."""
        return int(self.columns[self.camera_keys[-1]][-1]) + 1

    @cached_property
    def touched(self) -> int:
        """Number of the columns of those that factors of places have."""
        of_lenses = sum(len(term.variable.free) for term in self.lenses.values())
        return 6 * (len(self.tied_keys) + len(self.paired)) + of_lenses

    @cached_property
    def columns_of_matches(self) -> list[NDArray[np.intp]]:
        """Per matched camera, of o_p in front of all, m_c and s_c."""
        return [self._at_place([matched_key(n), *self.lens_keys(n)]) for n in self.matched]

    @cached_property
    def columns_of_pairs(self) -> list[NDArray[np.intp]]:
        """Per pair, of o_p in front of all, n_a and n_b."""
        return [self._at_place(pair.keys) for pair in self.pairs]

    def _at_place(self, keys: Iterable[int]) -> NDArray[np.intp]:
        return np.append(np.arange(6), 6 + self.columns_of(keys))


def latent_pose_graph(model: LatentPoseModel) -> gtsam.NonlinearFactorGraph:
    """The whole graph; its optimum is reported, and its marginal with what is considered.

    ``2 * graph.error(values)`` is the cost.
    """
    graph = join(model.shared_graph, model.place_graph, data_graph(model))
    for number, jacobian in enumerate(model.alignment if model.is_distorted else ()):
        edge, exact = (camera_key(number), aligned_key(number)), EXACT**2 * np.eye(6)
        graph.add(_tie(*edge, {DISTORTION: jacobian}, exact))
    return graph


def data_graph(model: LatentPoseModel) -> gtsam.NonlinearFactorGraph:
    """One factor per camera and place, and one per pair and place; lossless."""
    graph = gtsam.NonlinearFactorGraph()
    for place, camera in model.matched_places:
        keys = [cloud_at_key(place), matched_at_key(place, camera), *model.lens_keys(camera)]
        graph.add(model.blocks[model.cameras[camera]].factor(place, keys))
    for pair in model.pairs:
        for place, (first, end) in zip(pair.places.tolist(), to_runs(pair.edges), strict=True):
            features = pair.block.select(np.arange(first, end))
            graph.add(placed_factor([cloud_at_key(place), *pair.keys], features))
    return graph


def to_ordering(keys: Iterable[int]) -> gtsam.Ordering:
    """GTSAM's list of keys."""
    return gtsam.Ordering([*keys])


def _tie(
    one: int, two: int, shifts: Mapping[int, Array], covariance: Array
) -> gtsam.NonlinearFactor:
    """From a camera to where its data show it, displaced by vectors."""
    noise = _noise(covariance)
    if shifts:
        return displaced_between_factor(one, two, shifts, noise)
    return gtsam.BetweenFactorPose3(one, two, gtsam.Pose3(), noise)


def right_jacobians(twists: Array) -> Array:
    """(f, 6, 6) derivatives of Exp(-xi) Exp(xi + d) by d, of (f, 6) small xi, to fourth order."""
    ad = np.zeros((len(twists), 6, 6))
    for first, (x, y, z) in ((0, twists[:, :3].T), (3, twists[:, 3:].T)):
        ad[:, first + 2, 1], ad[:, first, 2], ad[:, first + 1, 0] = x, y, z
        ad[:, first + 1, 2], ad[:, first + 2, 0], ad[:, first, 1] = -x, -y, -z
    ad[:, 3:, 3:] = ad[:, :3, :3]
    square = ad @ ad
    return np.asarray(np.eye(6) - ad / 2 + square / 6 - square @ ad / 24)


def _distortion_graph(parts: VarianceComponents) -> gtsam.NonlinearFactorGraph:
    """The prior of the distortion, and its quadratic by the residuals."""
    graph, size = gtsam.NonlinearFactorGraph(), parts.distortion_jacobian.shape[2]
    noise = gtsam.noiseModel.Diagonal.Variances(np.broadcast_to(parts.distortion_size, size))
    graph.add(gtsam.PriorFactorVector(DISTORTION, np.zeros(size), noise))
    zero, quadratic = gtsam.Values(), (parts.distortion_information, parts.distortion_vector)
    zero.insert(DISTORTION, np.zeros(size))
    # At a negative error an optimizer would stop.
    shown = gtsam.HessianFactor(DISTORTION, *quadratic, parts.distortion_constant)
    graph.add(gtsam.LinearContainerFactor(shown, zero))
    return graph


def _noise(covariance: Array) -> gtsam.noiseModel.Gaussian:
    return gtsam.noiseModel.Gaussian.Covariance(covariance)


def _robust(covariance: Array, scale: float) -> gtsam.noiseModel.Base:
    noise = _noise(covariance)
    loss = gtsam.noiseModel.mEstimator.GemanMcClure.Create(scale)
    return noise if np.isinf(scale) else gtsam.noiseModel.Robust.Create(loss, noise)
