"""The minimum and the marginals of ``calibgraph.solver.hierarchy``, place by place.

The poses of a place meet only those that all places share. So its part of the normal equations is
eliminated by itself (Schur complement), of all places at once: the steps are those of Gauss-Newton
on the whole graph, at a fraction of the time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.model.geometry import adjoints, invert, invert_each
from calibgraph.solver.factor_graph import MAX_ITERATIONS
from calibgraph.solver.hierarchy import Hierarchy
from calibgraph.solver.hierarchy_poses import Poses, placed_edges, shared_edges
from factors import pair_run_sums, unit_diagonal

Array = NDArray[np.float64]

TOLERANCE = 1e-6
"""Relative change of the cost at which it stops: some 1e-3 of the smallest standard deviations."""

_SINGULAR = 1e-12  # smallest over largest eigenvalue: rounding noise

_ROUNDING = 2e-15  # smallest part of a sum that a difference may leave

_DAMPINGS = (0.0, *10.0 ** np.arange(-4, 5))
"""Of the diagonal: the first that descends; mostly none is needed."""


@dataclass(frozen=True, eq=False)
class HierarchyFit:
    """The minimum.

    Attributes:
        poses: of all variables.
        equations: normal equations there.
        shared_covariance: (G, G) marginal of all shared poses but the identity, in their tangents.
        place_slope: (P, L, G) the poses of a place move by minus this times the shared ones.
        place_covariance: (P, L, L) of the poses of a place, the shared ones given.
        distances: (P, 1 + N) in sigmas, of o_p from o and of a_cp from m_c.
        cost: twice GTSAM's error.
        iterations: of Gauss-Newton.
        converged: whether it stopped by its tolerance.
    """

    poses: Poses
    equations: Equations
    shared_covariance: Array
    place_slope: Array
    place_covariance: Array
    distances: Array
    cost: float
    iterations: int
    converged: bool

    @property
    def covariance(self) -> Array:
        """(6 N, 6 N) marginal of all x_c, in their tangents."""
        cameras = 6 * ((len(self.poses.shared) - 2) // 3)
        return self.shared_covariance[:cameras, :cameras]

    def place_weights(self, robust_scale: float) -> Array:
        """(P, N) by which a camera's matches at a place count, in the loss of places."""
        weight = (1.0 + (self.distances / robust_scale) ** 2) ** -2
        return np.asarray(weight[:, :1] * weight[:, 1:])

    def T_camera_lidar(self, model: Hierarchy) -> dict[str, Array]:
        """(4, 4) of every camera."""
        return dict(zip(model.cameras, invert(self.poses.shared), strict=False))


class Blocks:
    """Parts of the normal equations: the poses of a place meet its own and the shared.

    Attributes:
        shared: (S, S, 6, 6); placed: (P, L, L, 6, 6); across: (P, L, S, 6, 6) of the Hessian.
        shared_gradient: (S, 6); placed_gradient: (P, L, 6).
        cost: twice GTSAM's error.
    """

    def __init__(self, poses: Poses) -> None:
        S, (P, L) = len(poses.shared), poses.placed.shape[:2]
        self.shared, self.shared_gradient = np.zeros((S, S, 6, 6)), np.zeros((S, 6))
        self.placed, self.placed_gradient = np.zeros((P, L, L, 6, 6)), np.zeros((P, L, 6))
        self.across, self.cost = np.zeros((P, L, S, 6, 6)), 0.0

    def add(self, other: Blocks) -> None:
        """Add other parts, of the same poses."""
        self.shared += other.shared
        self.shared_gradient += other.shared_gradient
        self.placed += other.placed
        self.placed_gradient += other.placed_gradient
        self.across += other.across
        self.cost += other.cost

    def add_shared(self, numbers: Sequence[int], hessian: Array, gradient: Array) -> None:
        """What acts on some of the shared poses.

        Args:
            numbers: of these.
            hessian: (6 n, 6 n).
            gradient: (6 n,).
        """
        blocks = hessian.reshape(len(numbers), 6, len(numbers), 6).swapaxes(1, 2)
        self.shared[np.ix_(numbers, numbers)] += blocks
        self.shared_gradient[numbers] += gradient.reshape(-1, 6)


class DataSums(Blocks):
    """Correspondences and pairs of cameras at given poses, whatever the components of the error."""

    def __init__(self, model: Hierarchy, poses: Poses) -> None:
        super().__init__(poses)
        self._add_matches(model, poses)
        self._add_pairs(model, poses)

    def _add_matches(self, model: Hierarchy, poses: Poses) -> None:
        """Correspondences, on o_p^-1 a_cp."""
        for name, block in model.blocks.items():
            local = 1 + model.cameras.index(name)
            T_camera_cloud = invert_each(poses.placed[:, local]) @ poses.placed[:, 0]
            sums = block.sums(T_camera_cloud)
            cloud = -adjoints(T_camera_cloud)
            by_cloud = sums.hessian @ cloud
            self.cost += float(sums.cost.sum())
            self.placed[:, 0, 0] += cloud.transpose(0, 2, 1) @ by_cloud
            self.placed[:, local, 0] += by_cloud
            self.placed[:, 0, local] += by_cloud.transpose(0, 2, 1)
            self.placed[:, local, local] += sums.hessian
            self.placed_gradient[:, 0] += np.einsum("pij,pi->pj", cloud, sums.gradient)
            self.placed_gradient[:, local] += sums.gradient

    def _add_pairs(self, model: Hierarchy, poses: Poses) -> None:
        """Features that two cameras share, on o_p^-1 n_a and o_p^-1 n_b."""
        if not model.pairs:
            return
        N = len(model.cameras)
        T_cloud_lidar = invert_each(poses.placed[:, 0])
        T_paired_lidar = invert_each(poses.shared[2 * N : 3 * N])
        T_paired_cloud = T_paired_lidar[:, None] @ poses.placed[:, 0]
        by_cloud = -adjoints(T_paired_cloud.reshape(-1, 4, 4)).reshape(N, -1, 6, 6)
        for pair in model.pairs:
            cameras, places = [model.cameras.index(name) for name in (pair.a, pair.b)], pair.places
            numbers = [2 * N + camera for camera in cameras]
            seen = [T_cloud_lidar[places] @ poses.shared[number] for number in numbers]
            sums = pair_run_sums(pair.block, seen[0], seen[1], pair.edges)
            chain = np.concatenate([by_cloud[camera, places] for camera in cameras], axis=1)
            turned = chain.transpose(0, 2, 1)
            across = turned @ sums.hessian
            self.cost += float(sums.cost.sum())
            self.placed[places, 0, 0] += across @ chain
            self.placed_gradient[places, 0] += (turned @ sums.gradient[..., None])[..., 0]
            halves = across.reshape(-1, 6, 2, 6).transpose(0, 2, 1, 3)
            self.across[places[:, None], 0, numbers] += halves
            self.add_shared(numbers, sums.hessian.sum(axis=0), sums.gradient.sum(axis=0))


class Equations(Blocks):
    """The normal equations of all poses.

    Attributes:
        model: of the error.
        data: their part of the data.
        distances: (P, L) of the poses of a place from the shared ones, in sigmas.
    """

    def __init__(self, model: Hierarchy, poses: Poses, data: DataSums | None = None) -> None:
        super().__init__(poses)
        self.model = model
        self.data = DataSums(model, poses) if data is None else data
        self.add(self.data)
        self.distances: Array = np.zeros(poses.placed.shape[:2])
        self._add_shared(model, poses)
        self._add_places(model, poses)
        self._add_pose_graph(model, poses)

    @cached_property
    def reduced(self) -> tuple[Array, Array, Array]:
        """The places eliminated, without damping: see :meth:`eliminate`."""
        return self.eliminate(0.0)

    def eliminate(self, damping: float) -> tuple[Array, Array, Array]:
        """The places eliminated.

        Args:
            damping: by which the diagonals grow.

        Returns:
            (G, G) Hessian and (G,) gradient of the shared poses; (P, L, G + 1): the step of a place
            is minus its first G columns times the shared step, minus its last column.
        """
        P, L, S = self.across.shape[:3]
        free = S - 1  # the identity is fixed
        shared = self.shared[:free, :free].transpose(0, 2, 1, 3).reshape(6 * free, 6 * free).copy()
        placed = self.of_places().copy()
        across = self.across[:, :, :free].transpose(0, 1, 3, 2, 4).reshape(P, 6 * L, 6 * free)
        if damping:
            for matrix in (shared, placed):
                np.einsum("...ii->...i", matrix)[...] *= 1.0 + damping
        own = self.placed_gradient.reshape(P, 6 * L, 1)
        solved = np.linalg.solve(placed, np.concatenate([across, own], axis=2))
        removed = across.reshape(-1, 6 * free).T @ solved.reshape(-1, 6 * free + 1)
        hessian = shared - removed[:, :-1]
        gradient = self.shared_gradient[:free].ravel() - removed[:, -1]
        return (hessian + hessian.T) / 2, gradient, solved

    def of_places(self) -> Array:
        """(P, 6 L, 6 L) Hessians of the poses of each place."""
        P, L = self.distances.shape
        return self.placed.transpose(0, 1, 3, 2, 4).reshape(P, 6 * L, 6 * L)

    def is_determined(self, cameras: int) -> bool:
        """Whether x of so many cameras is, in all directions, but for rounding noise."""
        hessian, rows = self.reduced[0], 6 * cameras
        others = np.linalg.solve(hessian[rows:, rows:], hessian[rows:, :rows])
        of_cameras = hessian[:rows, :rows] - hessian[:rows, rows:] @ others
        diagonal = np.diag(of_cameras)
        if not np.isfinite(of_cameras).all() or diagonal.min() <= 0:
            return False
        values = np.linalg.eigvalsh(unit_diagonal(of_cameras)[0])
        before = np.sqrt(np.diag(hessian)[:rows])  # of which a difference is left
        left = np.linalg.eigvalsh(of_cameras / np.outer(before, before))[0]
        return bool(values[0] > _SINGULAR * values[-1] and left > _ROUNDING)

    def step(self, damping: float) -> tuple[Array, Array]:
        """Of the shared poses, and of those of each place."""
        hessian, gradient, solved = self.eliminate(damping) if damping else self.reduced
        shared = -np.asarray(np.linalg.solve(hessian, gradient))
        return shared, -(solved[..., :-1] @ shared + solved[..., -1])

    def _add_shared(self, model: Hierarchy, poses: Poses) -> None:
        edges, S = shared_edges(model, poses), len(poses.shared)
        self.cost += edges.squared
        hessian = edges.jacobian.T @ edges.information @ edges.jacobian
        self.shared += hessian.reshape(S, 6, S, 6).swapaxes(1, 2)
        self.shared_gradient += (edges.jacobian.T @ edges.weighted).reshape(S, 6)

    def _add_places(self, model: Hierarchy, poses: Poses) -> None:
        edges, (P, L) = placed_edges(model, poses), poses.placed.shape[:2]
        self.distances = np.sqrt(edges.squared).reshape(P, L)
        self.cost += float(edges.cost.sum())
        information = edges.information * edges.weight[:, None, None]
        both = np.concatenate([edges.to_second, edges.to_first, edges.error[..., None]], axis=2)
        own = edges.to_second.transpose(0, 2, 1) @ information @ both
        own, local, first = own.reshape(P, L, 6, 13), np.arange(L), edges.first[:L]
        self.placed[:, local, local] += own[..., :6]
        self.across[:, local, first] += own[..., 6:12]
        self.placed_gradient += own[..., 12]
        shared = edges.to_first.transpose(0, 2, 1) @ information @ both[..., 6:]
        of_all = shared.reshape(P, L, 6, 7).sum(axis=0)
        self.shared[first, first] += of_all[..., :6]
        self.shared_gradient[first] += of_all[..., 6]

    def _add_pose_graph(self, model: Hierarchy, poses: Poses) -> None:
        """Priors and measured relative poses, on x_c."""
        values, graph = gtsam.Values(), model.pose_graph
        if not graph.size():
            return
        for camera in range(len(model.cameras)):
            values.insert(gtsam.symbol("x", camera), gtsam.Pose3(poses.shared[camera]))
        jacobian, right = graph.linearize(values).jacobian()  # its columns by rising keys
        self.cost += float(right @ right)
        numbers = sorted(int(gtsam.symbolIndex(key)) for key in graph.keyVector())
        self.add_shared(numbers, jacobian.T @ jacobian, -jacobian.T @ right)


def fit_hierarchy(
    model: Hierarchy, start: Poses | HierarchyFit, *, relative_tolerance: float = TOLERANCE
) -> HierarchyFit | None:
    """Minimize by Gauss-Newton, damped where a whole step does not descend.

    Args:
        model: of the error.
        start: all poses, or a fit of the same data, from whose minimum it goes on.
        relative_tolerance: relative change of the cost at which it stops.

    Returns:
        None if a direction is not determined.
    """
    (poses, equations), iterations, converged = _equations_at(model, start), 0, False
    if not equations.is_determined(len(model.cameras)):
        return None
    while iterations < MAX_ITERATIONS and not converged:
        found = _descend(model, poses, equations)
        if found is None:  # to rounding, this is the minimum
            converged = True
            break
        converged = equations.cost - found[1].cost <= relative_tolerance * equations.cost
        (poses, equations), iterations = found, iterations + 1
    return _to_fit(poses, equations, iterations, converged)


def linearize(model: Hierarchy, fit: HierarchyFit) -> HierarchyFit:
    """A fit with the marginals of another model at the same poses."""
    return _to_fit(*_equations_at(model, fit), fit.iterations, fit.converged)


def bends_of(model: Hierarchy, fit: HierarchyFit) -> tuple[Array, Array]:
    """(B,) bends of the cloud in usual standard deviations, and their (B, B) marginal covariance.

    The eliminated form has them in the covariance of all m_c and n_c about x_c; here they return.

    Args:
        model: of the error.
        fit: its minimum.
    """
    edges, free = shared_edges(model, fit.poses), len(fit.shared_covariance)
    shifts, cameras = model.components.all_bends, slice(6, None)
    before = model.components.bend_covariance
    gain = before @ shifts.T @ edges.information[cameras, cameras]
    slope = gain @ edges.jacobian[cameras, :free]
    covariance = before - gain @ shifts @ before + slope @ fit.shared_covariance @ slope.T
    return model.components.bend_mean + gain @ edges.error[cameras], covariance


def _to_fit(poses: Poses, equations: Equations, iterations: int, converged: bool) -> HierarchyFit:
    hessian, _, solved = equations.reduced
    return HierarchyFit(
        poses,
        equations,
        np.asarray(np.linalg.inv(hessian)),
        solved[..., :-1],
        np.asarray(np.linalg.inv(equations.of_places())),
        equations.distances,
        equations.cost,
        iterations,
        converged,
    )


def _equations_at(model: Hierarchy, start: Poses | HierarchyFit) -> tuple[Poses, Equations]:
    """What a fit has summed up of the same data is not summed up again."""
    if isinstance(start, Poses):
        return start, Equations(model, start)
    known = start.equations
    if known.model is not model:
        known = Equations(model, start.poses, known.data)
    return start.poses, known


def _descend(
    model: Hierarchy, poses: Poses, equations: Equations
) -> tuple[Poses, Equations] | None:
    for damping in _DAMPINGS:
        there = poses.moved(*equations.step(damping))
        tried = Equations(model, there)
        if tried.cost <= equations.cost:
            return there, tried
    return None
