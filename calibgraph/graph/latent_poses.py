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
from scipy.linalg import block_diag

from calibgraph.arrays import Array
from calibgraph.graph.by_place import (
    BlockByPlace,
    PairByPlace,
)
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
    displaced_between_factor,
    placed_factor,
    to_runs,
)


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
        lens_errors: by the numbers of cameras, (6, 6) covariance of what is reported by what is
            considered of lens and clock.
        frames: the numbers of the frames of each place.
    """

    cameras: tuple[str, ...]
    blocks: Mapping[str, BlockByPlace]
    pairs: Sequence[PairByPlace]
    pose_graph: gtsam.NonlinearFactorGraph
    components: VarianceComponents
    of: Reported = "alignment"
    lenses: Mapping[int, LensTerm] = field(default_factory=dict)
    lens_errors: Mapping[int, Array] = field(default_factory=dict)
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
        T, rows = np.array(mounts), np.zeros((6 * len(mounts), self.size))
        at = self.columns_of(self.camera_keys)
        rows[np.arange(len(rows)), at] = 1.0
        if of == "mount" or not self.is_distorted:
            return T, rows
        away = self.alignment @ values.atVector(DISTORTION)
        turn = adjoints(retract_all(np.tile(np.eye(4), (len(T), 1, 1)), away))
        rows[:, at] = block_diag(*turn)
        by_distortion = right_jacobians(away) @ self.alignment
        rows[:, self.columns[DISTORTION]] = by_distortion.reshape(len(rows), -1)
        return retract_all(T, away), rows

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
        names = {name for pair in self.pairs for name in (pair.a, pair.b)}
        return [number for number, name in enumerate(self.cameras) if name in names]

    @cached_property
    def is_distorted(self) -> bool:
        """Whether the scan distortion is a variable."""
        parts = self.components
        return bool(parts.distortion_jacobian.any() or parts.pair_distortion_jacobian.any())

    @cached_property
    def matched_places(self) -> list[tuple[int, int]]:
        """Place and camera of every ``a_cp``."""
        return [
            (place, number)
            for number in self.matched
            for place in self.blocks[self.cameras[number]].places.tolist()
        ]

    @cached_property
    def present(self) -> NDArray[np.bool_]:
        """(M, P) where a matched camera has data."""
        found = np.zeros((len(self.matched), self.places), dtype=np.bool_)
        for row, number in enumerate(self.matched):
            found[row, self.blocks[self.cameras[number]].places] = True
        return found

    @cached_property
    def shared_graph(self) -> gtsam.NonlinearFactorGraph:
        """The factors of what all places share: of errors, pose graph, lenses."""
        return join(self.error_graph, self.pose_graph, self.lens_graph)

    @cached_property
    def lens_graph(self) -> gtsam.NonlinearFactorGraph:
        """Those of lenses."""
        return lens_graph(self.lenses, is_distorted=self.is_distorted)

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

    @property
    def touched_keys(self) -> list[int]:
        """Keys of the shared variables that factors of places have."""
        return [*self.tied_keys, *map(paired_key, self.paired), *map(seen_lens_key, self.lenses)]

    @cached_property
    def shared_keys(self) -> list[int]:
        """Keys of the variables that no place has of its own; the touched ones first."""
        distortion = [DISTORTION] if self.is_distorted else []
        return [
            *self.touched_keys, *map(lens_key, self.lenses), *distortion, *self.camera_keys
        ]  # fmt: skip

    @cached_property
    def columns(self) -> dict[int, NDArray[np.intp]]:
        """By key of a shared variable, its columns among all of them."""
        own = {DISTORTION: self.components.distortion_jacobian.shape[2]}
        for number, term in self.lenses.items():
            own[lens_key(number)] = own[seen_lens_key(number)] = len(term.variable.free)
        sizes = [own.get(key, 6) for key in self.shared_keys]
        parts = np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])
        return dict(zip(self.shared_keys, parts, strict=True))

    def columns_of(self, keys: Sequence[int]) -> NDArray[np.intp]:
        """The columns of some shared variables."""
        return np.concatenate([self.columns[key] for key in keys])

    @property
    def size(self) -> int:
        """Number of these columns."""
        return int(self.columns[self.shared_keys[-1]][-1]) + 1

    @cached_property
    def touched(self) -> int:
        """Number of the columns of those that factors of places have; they are the first."""
        return int(self.columns[self.touched_keys[-1]][-1]) + 1

    @cached_property
    def columns_of_matches(self) -> list[NDArray[np.intp]]:
        """Per matched camera, of o_p in front of all, m_c and s_c."""
        keys = [[matched_key(n), *self.lens_keys(n)] for n in self.matched]
        return [np.append(np.arange(6), 6 + self.columns_of(own)) for own in keys]

    @cached_property
    def columns_of_pairs(self) -> list[NDArray[np.intp]]:
        """Per pair, of o_p in front of all, n_a and n_b."""
        names = [(self.cameras.index(pair.a), self.cameras.index(pair.b)) for pair in self.pairs]
        keys = [[paired_key(a), paired_key(b)] for a, b in names]
        return [np.append(np.arange(6), 6 + self.columns_of(own)) for own in keys]


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
        key_a, key_b = (paired_key(model.cameras.index(name)) for name in (pair.a, pair.b))
        for place, (first, end) in zip(pair.places.tolist(), to_runs(pair.edges), strict=True):
            features = pair.block.select(np.arange(first, end))
            graph.add(placed_factor([cloud_at_key(place), key_a, key_b], features))
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
