"""Optimum and marginal of the error model (``calibgraph.graph.latent_poses``), by GTSAM.

Gauss-Newton, with steps shortened until they descend: the data enter as ``HessianFactor``s, the
stock factors are linearized by GTSAM, and GTSAM eliminates the poses of places first, which is a
Schur complement per place.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.graph.latent_poses import LatentPoseModel, to_ordering
from calibgraph.graph.lens import start_lenses
from calibgraph.graph.linear_data import LinearData, marginal_information, poses_of
from calibgraph.graph.variables import (
    CLOUD,
    DISTORTION,
    aligned_key,
    body_key,
    camera_key,
    cloud_at_key,
    matched_at_key,
    matched_key,
    paired_key,
)
from calibgraph.model.geometry import invert_each, to_T_camera_lidar, to_T_lidar_camera
from calibgraph.model.pose_kernel import logarithms
from calibgraph.solver.two_pass import MAX_ITERATIONS
from factors.conditioning import SINGULAR, unit_diagonal

TOLERANCE = 1e-6
"""Relative change of the cost at which it stops: some 1e-3 of the smallest standard deviations."""

_ROUNDING = 2e-15  # smallest part of a sum that a difference may leave
_SHARES = 0.5 ** np.arange(12)
"""Of a step: the first that descends; mostly the whole step."""


@dataclass(frozen=True, eq=False)
class Linearization:
    """The Gaussian graph of the error model at given values.

    Attributes:
        model: the graph.
        values: of all its variables.
        data: its quadratics there.
    """

    model: LatentPoseModel
    values: gtsam.Values
    data: LinearData

    @staticmethod
    def at(model: LatentPoseModel, values: gtsam.Values) -> Linearization:
        """Linearize the whole graph."""
        return Linearization(model, values, LinearData.at(model, values))

    def with_model(self, model: LatentPoseModel) -> Linearization:
        """The graph of another model of the same data, at the same values."""
        other = replace(self, model=model)
        if model.components is self.model.components:  # that of places is the same
            model.__dict__.setdefault("place_graph", self.model.place_graph)
            other.__dict__.update(placed=self.placed, left_by_places=self.left_by_places)
        return other

    @cached_property
    def shared(self) -> gtsam.GaussianFactorGraph:
        """The linear factors of what all places share."""
        return self.model.shared_graph.linearize(self.values)

    @cached_property
    def placed(self) -> gtsam.GaussianFactorGraph:
        """The linear factors of all places, data included."""
        return join_linear(self.model.place_graph.linearize(self.values), self.data.graph)

    @cached_property
    def left_by_places(self) -> gtsam.GaussianFactorGraph:
        """The same factors without the variables of places, which are eliminated."""
        return self.placed.eliminatePartialSequential(to_ordering(self.model.place_keys))[1]

    @cached_property
    def cost(self) -> float:
        """Twice GTSAM's error."""
        graphs = self.model.shared_graph, self.model.place_graph
        return self.data.cost + sum(2.0 * graph.error(self.values) for graph in graphs)

    @cached_property
    def information(self) -> Array:
        """(6 N, 6 N) marginal information of all reported poses."""
        return self._information_of(self.model.reported_keys)

    @cached_property
    def covariance(self) -> Array:
        """(6 N, 6 N) marginal covariance of all reported poses, in their tangents."""
        return np.asarray(np.linalg.inv(self.information))

    def covariance_of(self, keys: Sequence[int]) -> Array:
        """Marginal covariance of some variables, in their tangents."""
        return np.asarray(np.linalg.inv(self._information_of(keys)))

    def _information_of(self, keys: Sequence[int]) -> Array:
        graph = join_linear(self.shared, self.left_by_places)
        return marginal_information(graph, self.model.shared_keys, keys)

    @cached_property
    def distances(self) -> Array:
        """(P, 1 + N) in sigmas: of o_p from o, of a_cp from m_c; 0 where there are no data."""
        model, values, parts = self.model, self.values, self.model.components
        cloud, clouds = ([CLOUD], map(cloud_at_key, range(model.places)))
        found = np.zeros((model.places, 1 + len(model.cameras)))
        of_clouds = np.broadcast_to(parts.cloud_at_place, (model.places, 6, 6))
        found[:, 0] = _distances(values, cloud, clouds, of_clouds)
        places, numbers = np.array(model.matched_places, np.int64).reshape(-1, 2).T
        matched, at_place = map(matched_key, numbers), map(matched_at_key, places, numbers)
        found[places, 1 + numbers] = _distances(
            values, matched, at_place, parts.at_place[places, numbers]
        )
        return found

    @cached_property
    def step(self) -> gtsam.VectorValues:
        """The step of Gauss-Newton."""
        graph = join_linear(self.shared, self.placed)
        return graph.eliminateSequential(self.model.ordering).optimize()

    def descend(self) -> Linearization | None:
        """The graph after a step, shortened until it descends; None if no step does."""
        for share in _SHARES:
            values = self.values.retract(self.step if share == 1.0 else self.step.scale(share))
            tried = Linearization.at(self.model, values)
            if tried.cost <= self.cost:
                return tried
        return None

    def is_determined(self) -> bool:
        """Whether every direction of every camera is, but for rounding noise."""
        if not set(self.model.camera_keys) <= set(self.model.shared_graph.keyVector()):
            return False  # nothing acts on a camera
        try:
            information = self.information
        except RuntimeError:  # GTSAM finds an indeterminate linear system
            return False
        diagonal = np.diag(information)
        if not np.isfinite(information).all() or diagonal.min() <= 0:
            return False
        values = np.linalg.eigvalsh(unit_diagonal(information)[0])
        keys = to_ordering(self.model.shared_keys)
        before = np.sqrt(np.diag(self.shared.hessian(keys)[0])[-len(diagonal) :])
        left = np.linalg.eigvalsh(information / np.outer(before, before))[0]
        return bool(values[0] > SINGULAR * values[-1] and left > _ROUNDING)


@dataclass(frozen=True, eq=False)
class LatentPoseFit:
    """The optimum of the error model.

    Attributes:
        linear: the graph linearized there.
        iterations: number of Gauss-Newton steps.
        converged: whether it stopped by its tolerance.
    """

    linear: Linearization
    iterations: int
    converged: bool

    @property
    def cost(self) -> float:
        """Twice GTSAM's error."""
        return self.linear.cost

    @property
    def covariance(self) -> Array:
        """(6 N, 6 N) marginal of all reported poses, in their tangents."""
        return self.linear.covariance

    @property
    def T_lidar_camera(self) -> tuple[gtsam.Pose3, ...]:
        """All reported poses, in the order of the cameras."""
        return tuple(map(self.linear.values.atPose3, self.linear.model.reported_keys))

    @property
    def T_camera_lidar(self) -> dict[str, Array]:
        """Per camera, (4, 4) as reported."""
        poses = map(to_T_camera_lidar, self.T_lidar_camera)
        return dict(zip(self.linear.model.cameras, poses, strict=True))

    @cached_property
    def of_mount(self) -> LatentPoseFit:
        """The same optimum; the mounts are reported, with the lenses as the rig has them."""
        if self.linear.model.reported_keys == self.linear.model.camera_keys:
            return self
        return self.with_model(replace(self.linear.model, of="mount", lens_errors={}))

    @cached_property
    def distortion(self) -> tuple[Array, Array]:
        """(B,) scan distortion in prior standard deviations, and its (B, B) marginal covariance."""
        if not self.linear.model.is_distorted:
            size = self.linear.model.components.distortion_jacobian.shape[2]
            return np.zeros(size), np.eye(size)
        return self.linear.values.atVector(DISTORTION), self.linear.covariance_of([DISTORTION])

    def place_weights(self, robust_scale: float) -> Array:
        """(P, 1 + N) weights of the cloud and of each camera at each place, in a robust loss."""
        return np.asarray((1.0 + (self.linear.distances / robust_scale) ** 2) ** -2)

    def with_model(self, model: LatentPoseModel) -> LatentPoseFit:
        """The marginals of another model of the same data, at the same values."""
        return replace(self, linear=self.linear.with_model(model))


def fit_latent_poses(
    model: LatentPoseModel,
    start: gtsam.Values | LatentPoseFit,
    *,
    relative_tolerance: float = TOLERANCE,
    is_determined: bool = False,
) -> LatentPoseFit | None:
    """Minimize by Gauss-Newton with steps that descend; None if a direction is not determined.

    Args:
        model: the graph.
        start: values of all its variables, or a fit of the same data, which is continued.
        relative_tolerance: relative change of the cost at which it stops.
        is_determined: whether all directions are known to be; else that is tested.
    """
    if isinstance(start, LatentPoseFit):
        present = start.linear
        is_determined = is_determined or present.model is model
        present = present if present.model is model else present.with_model(model)
    else:
        present = Linearization.at(model, start)
    if not (is_determined or present.is_determined()):
        return None
    iterations, converged = 0, False
    while iterations < MAX_ITERATIONS and not converged:
        try:
            found = present.descend()
        except RuntimeError:  # GTSAM finds an indeterminate linear system
            return None
        if found is None:  # this is the minimum, to rounding
            return LatentPoseFit(present, iterations, True)
        converged = present.cost - found.cost <= relative_tolerance * present.cost
        present, iterations = found, iterations + 1
    return LatentPoseFit(present, iterations, converged)


def start_values(model: LatentPoseModel, T_camera_lidar: Mapping[str, Array]) -> gtsam.Values:
    """All poses of a camera at its (4, 4) extrinsic, the cloud and lenses where they are."""
    values, no_motion = gtsam.Values(), gtsam.Pose3()
    poses = [to_T_lidar_camera(T_camera_lidar[name]) for name in model.cameras]
    for number, pose in enumerate(poses):
        values.insert(camera_key(number), pose)
    for number in model.aligned:
        values.insert(aligned_key(number), poses[number])
    for number in model.lens_errors:
        values.insert(body_key(number), poses[number])
    for number in model.matched:
        values.insert(matched_key(number), poses[number])
    for number in model.paired:
        values.insert(paired_key(number), poses[number])
    for place, number in model.matched_places:
        values.insert(matched_at_key(place, number), poses[number])
    values.insert(start_lenses(model.lenses))
    for key in [CLOUD, *map(cloud_at_key, range(model.places))]:
        values.insert(key, no_motion)
    if model.is_distorted:
        values.insert(DISTORTION, np.zeros(model.components.distortion_jacobian.shape[2]))
    return values


def join_linear(*graphs: gtsam.GaussianFactorGraph) -> gtsam.GaussianFactorGraph:
    """One graph with the linear factors of all."""
    joined = gtsam.GaussianFactorGraph()
    for graph in graphs:
        joined.push_back(graph)
    return joined


def _distances(
    values: gtsam.Values, one: Iterable[int], other: Iterable[int], covariances: Array
) -> Array:
    """(n,) distances in sigmas of poses from others, by their keys."""
    twists = logarithms(invert_each(poses_of(values, one)) @ poses_of(values, other))
    along = np.linalg.solve(covariances, twists[:, :, None])[:, :, 0]
    return np.asarray(np.sqrt((twists * along).sum(axis=1)))
