"""Optimum and marginal of the error model (``calibgraph.graph.latent_poses``), places stacked.

Gauss-Newton, with steps shortened until they descend. The graph is a tree: what all places share,
then per place p the cloud o_p about o, and per camera c the pose a_cp about m_c. At present values,
with y the steps of the shared variables, the data of a camera at a place are a quadratic (H, g) in
the step v of the pose o_p^-1 a_cp and in that of a free lens, and the tie to m_c is

    v = c + u,   c = Ad_m m - Ad_o o_p - e,   u of covariance S,

with e the displacement from m_c to a_cp at present. Minimized over u,

    H' = H - H_6^T T H_6,   g' = g - H_6^T T g_6,   T = S (1 + H_66 S)^-1

with the index 6 for the rows of the pose: a quadratic in c, o_p and m_c, whatever the inverse of S.
The sum over cameras is one in o_p and y; o_p about o is eliminated by the same formula, and the sum
over places is one quadratic in y. GTSAM linearizes the factors of what all places share. Backwards,
u = -T (H_6 c + g_6), whose covariance is T plus that of the first term.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.graph.components import VarianceRatios
from calibgraph.graph.latent_poses import LatentPoseModel, right_jacobians, to_ordering
from calibgraph.graph.variables import (
    CLOUD,
    DISTORTION,
    camera_key,
    lens_key,
    matched_key,
    paired_key,
    seen_lens_key,
)
from calibgraph.model.geometry import (
    adjoints,
    invert,
    retract_all,
    to_T_lidar_camera,
)
from calibgraph.solver.two_pass import MAX_ITERATIONS
from factors import BlockSums
from factors.conditioning import unit_diagonal
from factors.pose_kernel import logarithms

TOLERANCE = 1e-6
"""Relative change of the cost at which it stops: some 1e-3 of the smallest standard deviations."""

_FREE = 1e3  # rad and m: a standard deviation that no correspondences have
_SHARES = 0.5 ** np.arange(12)
"""Of a step: the first that descends; mostly the whole step."""
_FARTHEST, _LEAST = 2.5, 0.1  # steps at once, where the slope shows that it pays


class Ties(NamedTuple):
    """Poses at all places about those that they share: o_p about o, and every a_cp about its m_c.

    The leading axes (1 + M, P) are those of the cloud and the matched cameras, and of places.

    Attributes:
        error: (..., 6) e, the displacement at present.
        distance: (...) of it, in sigmas.
        weight: (...) in the robust loss.
        turn: (..., 6, 6) from the axes and the size of S to those of ``covariance``.
        covariance: (..., 6, 6) S in the tangents at present, over the weight.
        by_shared: (..., 6, 6) Ad_m, or that of ``o`` to ``o_p``.
    """

    error: Array
    distance: Array
    weight: Array
    turn: Array
    covariance: Array
    by_shared: Array

    @staticmethod
    def of(shared: Array, inverses: Array, covariance: Array, scale: float) -> Ties:
        """From (1 + M, 4, 4) to (1 + M, P, 4, 4) inverses; the scale is that of the loss."""
        away = (inverses @ shared[:, None]).reshape(-1, 4, 4)
        error = -logarithms(away)
        turn, shape = right_jacobians(error).reshape(covariance.shape), covariance.shape[:-1]
        error = error.reshape(shape)
        squared = (error * _times(_inverses(covariance), error)).sum(axis=-1)
        weight = (1.0 + squared / scale**2) ** -2
        turn = turn / np.sqrt(weight)[..., None, None]
        own = turn @ covariance @ _turned(turn)
        return Ties(error, np.sqrt(squared), weight, turn, own, adjoints(away).reshape(own.shape))

    def cost(self, scale: float) -> float:
        """Twice the error of the factors."""
        squared = self.distance**2
        return float((squared / (1.0 + squared / scale**2)).sum())


class Displacement(NamedTuple):
    """The displacements u by the data: u = -T (V y + g), with y the steps of shared variables.

    Attributes:
        rows: (..., 6, k) V.
        pull: (..., 6) g.
        spread: (..., 6, 6) covariance of V y + g where y is known.
        left: (..., 6, 6) (1 + H_66 S)^-1.
        free: (..., 6, 6) T.
    """

    rows: Array
    pull: Array
    spread: Array
    left: Array
    free: Array

    def step(self, shared: Array) -> Array:
        """(..., 6) of (k,) shared steps."""
        return -_times(self.free, self.rows @ shared + self.pull)

    def open_freedom(self, shared: Array) -> Array:
        """(...) tr(S^-1 Cov(u)), by the (k, k) covariance of y."""
        known = self.rows @ shared @ _turned(self.rows) + self.spread
        open_: Array = np.trace(self.left + self.left @ known @ self.free, axis1=-2, axis2=-1)
        return open_

    def variances_by(self, part: Array, across: Array) -> Array:
        """(n,) variances that a part of S, (..., 6, 6), gives; across: (n, k) covariance with y."""
        moved = across @ _turned(self.left @ self.rows)
        return np.asarray(((moved @ part) * moved).sum(axis=-1).reshape(-1, len(across)).sum(0))


class Places(NamedTuple):
    """The data of all places as quadratics in the shared variables that they touch.

    Attributes:
        hessian: (P, k, k).
        gradient: (P, k).
        cloud: (P, ...) of o_p about o.
        cameras: (M, P, ...) of a_cp about m_c.
    """

    hessian: Array
    gradient: Array
    cloud: Displacement
    cameras: Displacement


@dataclass(frozen=True, eq=False)
class Linearization:
    """The Gaussian graph of the error model at given values.

    Attributes:
        model: the graph.
        shared: values of the variables that places share.
        inverses: (1 + M, P, 4, 4) inverses of o_p, and of a_cp of the cameras ``model.matched``.
    """

    model: LatentPoseModel
    shared: gtsam.Values
    inverses: Array

    def with_model(self, model: LatentPoseModel) -> Linearization:
        """The graph of another model of the same data, at the same values."""
        other = replace(self, model=model)
        other.__dict__.update(data=self.data, pairs=self.pairs)
        return other

    @cached_property
    def _T_camera_cloud(self) -> Array:
        """(M, P, 4, 4) of the data."""
        return self.inverses[1:] @ invert(self.inverses[0])

    @cached_property
    def data(self) -> BlockSums:
        """The sums of all matched cameras at all places, (M, P, 6 + k, 6 + k); k of all lenses."""
        model = self.model
        k = max((len(term.variable.free) for term in model.lenses.values()), default=0)
        shape = len(model.matched), model.places, 6 + k
        found = BlockSums(np.zeros((*shape, 6 + k)), np.zeros(shape), np.zeros(shape[:2]))
        for row, number in enumerate(model.matched):
            block, T = model.blocks[model.cameras[number]], self._T_camera_cloud[row]
            sums = block.sums(T, *map(self.shared.atVector, model.lens_keys(number)))
            n = sums.gradient.shape[1]
            found.hessian[row, :, :n, :n], found.gradient[row, :, :n] = sums.hessian, sums.gradient
            found.cost[row] = sums.cost
        return found

    @cached_property
    def pairs(self) -> list[BlockSums]:
        """The sums of every pair by place, in the tangents of o_p, n_a and n_b: (r, 18, 18)."""
        found = []
        for pair in self.model.pairs:
            shown = _poses(self.shared, pair.keys)
            seen = self.inverses[0, pair.places] @ shown[:, None]
            sums = pair.block.run_sums(seen[0], seen[1], pair.edges)
            by_cloud = -adjoints(invert(seen.reshape(-1, 4, 4))).reshape(2, -1, 6, 6)
            by = np.tile(np.eye(12, 18, 6), (len(pair.places), 1, 1))
            by[:, :6, :6], by[:, 6:, :6] = by_cloud
            hessian, gradient = _turned(by) @ sums.hessian @ by, _times(_turned(by), sums.gradient)
            found.append(BlockSums(hessian, gradient, sums.cost))
        return found

    @cached_property
    def ties(self) -> Ties:
        """O to o_p; then m_c to a_cp, per matched camera."""
        parts, model = self.model.components, self.model
        covariance = np.empty((*self.inverses.shape[:2], 6, 6))
        covariance[0] = parts.cloud_at_place
        covariance[1:] = parts.at_place[:, model.matched].swapaxes(0, 1)
        shared = _poses(self.shared, model.tied_keys)
        return Ties.of(shared, self.inverses, covariance, parts.robust_scale)

    @property
    def distances(self) -> Array:
        """(P, 1 + N) in sigmas: of o_p from o, of a_cp from m_c; 0 where there are no data."""
        found = np.zeros((self.model.places, 1 + len(self.model.cameras)))
        found[:, [0, *(1 + number for number in self.model.matched)]] = self.ties.distance.T
        return found

    @cached_property
    def places(self) -> Places:
        """All variables of places eliminated."""
        model, count, k = self.model, self.model.places, self.model.touched
        hessian, gradient = np.zeros((count, 6 + k, 6 + k)), np.zeros((count, 6 + k))
        error, covariance, by_shared = self.ties.error, self.ties.covariance, self.ties.by_shared
        size = self.data.gradient.shape[-1]
        by = np.zeros((len(model.matched), count, size, 6 + size))
        by[..., 6:] = np.eye(size)
        by[..., :6, :6] = -adjoints(self._T_camera_cloud.reshape(-1, 4, 4)).reshape(
            *by.shape[:2], 6, 6
        )
        by[..., :6, 6:12] = by_shared[1:]
        softened, pulled, seen = soften(
            self.data.hessian, self.data.gradient, covariance[1:], error[1:]
        )
        of_cameras, pulls = _turned(by) @ softened @ by, _times(_turned(by), pulled)
        for row, at in enumerate(model.columns_of_matches):
            hessian[:, at[:, None], at] += of_cameras[row, :, : len(at), : len(at)]
            gradient[:, at] += pulls[row, :, : len(at)]
        for pair, sums, at in zip(model.pairs, self.pairs, model.columns_of_pairs, strict=True):
            hessian[np.ix_(pair.places, at, at)] += sums.hessian
            gradient[np.ix_(pair.places, at)] += sums.gradient
        softened, pulled, own = soften(hessian, gradient, covariance[0], error[0])
        by_cloud = np.tile(np.eye(6 + k, k, -6), (count, 1, 1))
        by_cloud[:, :6, :6] = by_shared[0]
        cloud = own._replace(rows=own.rows @ by_cloud)
        still = -_times(own.free, own.pull) - error[0]  # of o_p where y is zero
        moved = by_cloud[:, :6] - own.free @ cloud.rows
        across = seen.rows @ by
        by_own = across[..., :6]
        rows = by_own @ moved
        for row, at in enumerate(model.columns_of_matches):
            rows[row][:, :, at[6:] - 6] += across[row, :, :, 6 : len(at)]
        cameras = seen._replace(
            rows=rows,
            pull=seen.pull + _times(by_own, still),
            spread=by_own @ own.free @ _turned(by_own),
        )
        return Places(
            _turned(by_cloud) @ softened @ by_cloud,
            _times(_turned(by_cloud), pulled),
            cloud,
            cameras,
        )

    @cached_property
    def shared_factors(self) -> gtsam.GaussianFactorGraph:
        """The linear factors of what all places share."""
        return self.model.shared_graph.linearize(self.shared)

    @cached_property
    def shared_hessian(self) -> tuple[Array, Array]:
        """(n, n) and (n,) gradient, of these."""
        return self.hessian_of(self.shared_factors)

    def hessian_of(self, factors: gtsam.GaussianFactorGraph) -> tuple[Array, Array]:
        """(n, n) and (n,) gradient of linear factors of shared variables."""
        n, present = self.model.size, {*factors.keys()}
        hessian, gradient = np.zeros((n, n)), np.zeros(n)
        keys = [key for key in self.model.columns if key in present]
        own, at = factors.hessian(to_ordering(keys)), self.model.columns_of(keys)
        hessian[np.ix_(at, at)], gradient[at] = own[0], -own[1]
        return hessian, gradient

    def hessian(self, times: float = 1.0) -> Array:
        """(n, n) of all shared variables, places eliminated; these so many times."""
        whole, own = self.shared_hessian[0].copy(), self.places.hessian.sum(axis=0)
        whole[: len(own), : len(own)] += times * own
        return whole

    @cached_property
    def joint_covariance(self) -> Array:
        """(n, n) of all shared variables, in their tangents."""
        return invert_scaled(self.hessian())

    def covariance_of(self, keys: Sequence[int]) -> Array:
        """Marginal covariance of some shared variables, in their tangents."""
        at = self.model.columns_of(keys)
        return self.joint_covariance[np.ix_(at, at)]

    @cached_property
    def cost(self) -> float:
        """Twice GTSAM's error."""
        of_data = float(sum(sums.cost.sum() for sums in (self.data, *self.pairs)))
        ties = self.ties.cost(self.model.components.robust_scale)
        if self.model.lenses:  # whose priors are robust
            return of_data + ties + 2.0 * self.model.shared_graph.error(self.shared)
        return of_data + ties + 2.0 * self.shared_factors.error(self.shared.zeroVectors())

    @cached_property
    def gradient(self) -> Array:
        """(n,) by the shared variables, places eliminated."""
        gradient, own = self.shared_hessian[1].copy(), self.places.gradient.sum(axis=0)
        gradient[: len(own)] += own
        return gradient

    @cached_property
    def step(self) -> Array:
        """(n,) of the shared variables, by Gauss-Newton."""
        scaled, units = unit_diagonal(self.hessian())
        return -np.asarray(np.linalg.solve(scaled, self.gradient / units)) / units

    def moved(self, share: float) -> Linearization:
        """The graph after a part of the step."""
        model, ties, step, of_shared = self.model, self.ties, self.step, gtsam.VectorValues()
        for key, at in model.columns.items():
            of_shared.insert(key, share * step[at])
        y = step[: model.touched]
        tied = step[model.columns_of(model.tied_keys)].reshape(-1, 1, 6)
        own = np.concatenate([self.places.cloud.step(y)[None], self.places.cameras.step(y)])
        steps = share * (_times(ties.by_shared, tied) - ties.error + own)
        moved = retract_all(self.inverses.reshape(-1, 4, 4), steps.reshape(-1, 6))
        shared = self.shared.retract(of_shared)
        return Linearization(model, shared, moved.reshape(self.inverses.shape))

    def is_determined(self) -> bool:
        """Whether every direction of every camera is: of a free one rounding leaves far more."""
        if not {*self.model.camera_keys} <= {*self.model.shared_graph.keyVector()}:
            return False  # nothing acts on a camera
        try:
            variances = np.diag(self.covariance_of(self.model.camera_keys))
        except np.linalg.LinAlgError:
            return False
        return bool(((variances > 0) & (variances < _FREE**2)).all())


def soften(
    hessian: Array, gradient: Array, covariance: Array, error: Array | None = None
) -> tuple[Array, Array, Displacement]:
    """A quadratic whose pose has been set free about a tie, in the step of c + e.

    Of (..., k, k) and (..., k), the pose in front, S and e, which is zero if it is None.
    """
    pulled = gradient if error is None else gradient - _times(hessian[..., :6], error)
    whole = np.concatenate([hessian, pulled[..., None]], axis=-1)
    rows = whole[..., :6, :]
    left = _inverses(np.eye(6) + rows[..., :6] @ covariance)
    free = covariance @ left
    free = (free + _turned(free)) / 2
    softened = whole - _turned(hessian[..., :6, :]) @ (free @ rows)
    softened[..., :6, :] = left @ rows
    softened[..., :6] = _turned(softened[..., :6, :-1])
    own = Displacement(rows[..., :-1], rows[..., -1], np.zeros_like(free), left, free)
    return softened[..., :-1], softened[..., -1], own


@dataclass(frozen=True, eq=False)
class ErrorFit:
    """The optimum of the error model.

    Attributes:
        linear: the graph linearized there.
        change: of the cost by the last step, relative to it.
        is_of_mount: whether mounts are reported, with the lenses as the rig has them, whatever the
            model reports.
        ratios: of its variance components.
        without_priors: the optimum without measured relative poses and priors, where some are
            measured.
    """

    linear: Linearization
    change: float
    is_of_mount: bool = False
    ratios: VarianceRatios = VarianceRatios()
    without_priors: ErrorFit | None = None

    @property
    def converged(self) -> bool:
        """Whether it is the minimum."""
        return self.change <= TOLERANCE

    @property
    def model(self) -> LatentPoseModel:
        """The graph."""
        return self.linear.model

    @property
    def cost(self) -> float:
        """Twice GTSAM's error."""
        return self.linear.cost

    @cached_property
    def _reported(self) -> tuple[Array, Array]:
        of = "mount" if self.is_of_mount else self.model.of
        return self.model.reported(self.linear.shared, of)

    @property
    def rows(self) -> Array:
        """(6 N, n) derivative of all reported poses by the shared variables, in their tangents."""
        return self._reported[1]

    @property
    def by_lenses(self) -> Array:
        """(6 N, 6 N) covariance of the reported poses by what is considered of their lenses."""
        considered = self.model.considered
        return np.zeros_like(considered) if self.is_of_mount else considered

    @cached_property
    def covariance(self) -> Array:
        """(6 N, 6 N) marginal of all reported poses, in their tangents."""
        return self.rows @ self.linear.joint_covariance @ self.rows.T + self.by_lenses

    @property
    def T_camera_lidar(self) -> dict[str, Array]:
        """Per camera, (4, 4) as reported."""
        return dict(zip(self.model.cameras, self._reported[0], strict=True))

    @cached_property
    def of_mount(self) -> ErrorFit:
        """The same optimum; the mounts are reported, with the lenses as the rig has them."""
        return replace(self, is_of_mount=True)

    @property
    def distortion(self) -> tuple[Array, Array]:
        """(B,) scan distortion in prior standard deviations, and its (B, B) marginal covariance."""
        if not self.model.is_distorted:
            size = self.model.components.distortion_jacobian.shape[2]
            return np.zeros(size), np.eye(size)
        return self.linear.shared.atVector(DISTORTION), self.linear.covariance_of([DISTORTION])

    def with_shared_ratio(self, least: float) -> ErrorFit:
        """The same optimum; the covariances of what all places share have at least this ratio."""
        factor = least / self.ratios.shared
        if factor <= 1.0:
            return self
        parts = self.model.components
        components = replace(
            parts,
            cloud=factor * parts.cloud,
            camera=factor * parts.camera,
            distortion_size=factor * parts.distortion_size,
        )
        linear = self.linear.with_model(replace(self.model, components=components))
        return replace(self, linear=linear, ratios=replace(self.ratios, shared=least))


def fit_latent_poses(
    model: LatentPoseModel, start: Linearization, *, relative_tolerance: float = TOLERANCE
) -> ErrorFit | None:
    """Minimize by Gauss-Newton with steps that descend; None where the algebra fails.

    Args:
        model: the graph.
        start: at some values, of a model of the same data.
        relative_tolerance: relative change of the cost at which it stops.
    """
    present = start if start.model is model else start.with_model(model)
    change, reach = np.inf, 1.0
    for _ in range(MAX_ITERATIONS):
        try:
            tried = ((share, present.moved(share)) for share in (reach, *_SHARES))
            lower = ((share, each) for share, each in tried if each.cost <= present.cost)
            share, found = next(lower, (0.0, present))
        except np.linalg.LinAlgError:
            return None
        if not share:  # this is the minimum, to rounding
            return ErrorFit(present, 0.0)
        change = (present.cost - found.cost) / max(present.cost, np.finfo(float).tiny)
        if change <= relative_tolerance:
            return ErrorFit(found, change)
        before, left = (float(each.gradient @ present.step) for each in (present, found))
        reach, present = lengthen(share, left / before), found
    return ErrorFit(present, change)


def lengthen(share: float, left: float) -> float:
    """The next step's length, where the last of this length has left so much of the slope.

    A robust loss is flatter than its weights say, so that Gauss-Newton falls short.
    """
    return float(np.clip(share / max(1.0 - left, _LEAST), 1.0, _FARTHEST))


def start_values(model: LatentPoseModel, T_camera_lidar: Mapping[str, Array]) -> Linearization:
    """All poses of a camera at its (4, 4) extrinsic, the cloud and lenses where they are."""
    shared, T = gtsam.Values(), [T_camera_lidar[name] for name in model.cameras]
    for number, pose in enumerate(map(to_T_lidar_camera, T)):
        for key in (camera_key(number), matched_key(number), paired_key(number)):
            if key in model.columns:
                shared.insert(key, pose)
    for number, term in model.lenses.items():
        for key in (lens_key(number), seen_lens_key(number)):
            shared.insert(key, term.variable.values)
    shared.insert(CLOUD, gtsam.Pose3())
    if model.is_distorted:
        shared.insert(DISTORTION, np.zeros(len(model.columns[DISTORTION])))
    each = np.array([np.eye(4), *(T[number] for number in model.matched)])
    return Linearization(model, shared, np.tile(each[:, None], (1, model.places, 1, 1)))


def invert_scaled(hessian: Array) -> Array:
    """The inverse, in units in which the diagonal is one."""
    scaled, units = unit_diagonal(hessian)
    inverse = np.linalg.inv(scaled)
    return np.asarray((inverse + inverse.T) / 2 / np.outer(units, units))


def _poses(values: gtsam.Values, keys: Iterable[int]) -> Array:
    """(n, 4, 4)."""
    return np.array([values.atPose3(key).matrix() for key in keys])


def _turned(matrices: Array) -> Array:
    return matrices.swapaxes(-1, -2)


def _inverses(matrices: Array) -> Array:
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)


def _times(matrices: Array, vectors: Array) -> Array:
    """(P, n) from (P, n, k) and (P, k)."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])
