"""The poses of ``calibgraph.solver.hierarchy`` and the between factors that tie them, in arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.geometry import invert
from calibgraph.model.pose_kernel import between_errors, exponential_times
from calibgraph.solver.hierarchy import Hierarchy

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Poses:
    """All poses of the graph, of variables ``T_lidar_*``.

    Attributes:
        shared: (3 N + 2, 4, 4): x of every camera, then m, then n, then o, and the identity.
        placed: (P, 1 + N, 4, 4): of each place o_p, then a_cp of every camera.
    """

    shared: Array
    placed: Array

    def moved(self, shared: Array, placed: Array) -> Poses:
        """By tangents, as GTSAM's ``retract``: (6 (3 N + 1),) and (P, 6 (1 + N))."""
        fixed = np.concatenate([shared, np.zeros(6)])
        return Poses(_retract(self.shared, fixed), _retract(self.placed, placed))


def start_poses(model: Hierarchy, T_camera_lidar: Mapping[str, Array]) -> Poses:
    """All poses of a camera at its (4, 4) extrinsic, the cloud where it is."""
    cloud = np.eye(4)[None]
    T_lidar_camera = invert(np.stack([T_camera_lidar[name] for name in model.cameras]))
    placed = np.tile(np.concatenate([cloud, T_lidar_camera]), (model.places, 1, 1, 1))
    return Poses(np.concatenate([*3 * [T_lidar_camera], cloud, cloud]), placed)


@dataclass(frozen=True, eq=False)
class Edges:
    """Between factors, measured at the identity.

    Attributes:
        first, second: (n,) the shared pose, and the other one (of places: as they are stacked).
        error: (n, 6) log(first^-1 second).
        to_first, to_second: (n, 6, 6) its derivatives.
        information: (n, 6, 6) without the loss.
        robust_scale: of the loss of Geman and McClure; infinite: none.
    """

    first: Index
    second: Index
    error: Array
    to_first: Array
    to_second: Array
    information: Array
    robust_scale: float

    @cached_property
    def squared(self) -> Array:
        """(n,) squared distances in sigmas."""
        return np.asarray(np.einsum("ni,nij,nj->n", self.error, self.information, self.error))

    @cached_property
    def cost(self) -> Array:
        """(n,) by the loss."""
        return np.asarray(self.squared / (1.0 + self.squared / self.robust_scale**2))

    @cached_property
    def weight(self) -> Array:
        """(n,) the loss' derivative."""
        return np.asarray((1.0 + self.squared / self.robust_scale**2) ** -2)


@dataclass(frozen=True, eq=False)
class SharedEdges:
    """The prior of o, and all x_c to m_c and to n_c: one factor, since bends tie the cameras.

    Attributes:
        error: (6 E,) log(first^-1 second) of each.
        jacobian: (6 E, 6 S) by the tangents of all shared poses.
        information: (6 E, 6 E).
    """

    error: Array
    jacobian: Array
    information: Array

    @cached_property
    def weighted(self) -> Array:
        """(6 E,) the information times the error."""
        return np.asarray(self.information @ self.error)

    @property
    def squared(self) -> float:
        """Squared distance in sigmas."""
        return float(self.error @ self.weighted)


def shared_edges(model: Hierarchy, poses: Poses) -> SharedEdges:
    """The prior of o; x_c to m_c and to n_c."""
    N, S = len(model.cameras), len(poses.shared)
    first = np.r_[3 * N + 1, np.arange(N), np.arange(N)]
    second = np.r_[3 * N, N : 2 * N, 2 * N : 3 * N]
    error, to_first, to_second = between_errors(poses.shared[first], poses.shared[second])
    bent = model.components.all_bends @ model.components.bend_mean
    error[1:] -= bent.reshape(2 * N, 6)
    jacobian, edges = np.zeros((len(first), 6, S, 6)), np.arange(len(first))
    jacobian[edges, :, first], jacobian[edges, :, second] = to_first, to_second
    information = model.components.shared_information
    return SharedEdges(error.ravel(), jacobian.reshape(6 * len(first), 6 * S), information)


def placed_edges(model: Hierarchy, poses: Poses) -> Edges:
    """O to o_p and m_c to a_cp, with the loss of places."""
    N, parts = len(model.cameras), model.components
    first, flat = np.tile(np.r_[3 * N, N : 2 * N], model.places), poses.placed.reshape(-1, 4, 4)
    information = parts.place_information.reshape(-1, 6, 6)
    error, by_one, by_two = between_errors(poses.shared[first], flat)
    number = np.arange(len(flat))
    return Edges(first, number, error, by_one, by_two, information, parts.robust_scale)


def _retract(T: Array, tangents: Array) -> Array:
    """T exp(xi)."""
    steps = np.ascontiguousarray(tangents.reshape(-1, 6))
    motion = np.empty((len(steps), 4, 4))
    exponential_times(steps, np.tile(np.eye(4), (len(steps), 1, 1)), motion)
    moved: Array = T @ motion.reshape(T.shape)
    return moved
