"""The error model of the batch (``calibgraph.graph.latent_poses``) while frames come in.

Until the end of an epoch all but its own frames stays the same: the sums of closed epochs, place by
place, the weights that places have in their robust loss, and the graph of what all places share. An
update eliminates the places of the open epoch and exchanges one factor of that graph.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from calibgraph.arrays import Array, Mask
from calibgraph.graph.components import VarianceComponents, least_cost_of_distortion
from calibgraph.graph.latent_poses import LatentPoseModel
from calibgraph.graph.objective import objective_graph
from calibgraph.model.findings import error_components
from calibgraph.model.geometry import retract_all
from calibgraph.solver.components import (
    Component,
    Evidence,
    common_error,
    pose_covariance,
    ratios_by_evidence,
)
from calibgraph.solver.covariance import ENOUGH_FRAMES, pose_equations
from calibgraph.solver.error_model import Conflict, relative_pose_conflict
from calibgraph.solver.places import Displacement, soften
from calibgraph.solver.within_place import (
    WEAK,
    allow_for_few_frames,
    relative_covariance,
    split_excess,
)
from calibgraph.tracking.cause import sure_inflation
from calibgraph.tracking.state import State, rows_of
from calibgraph.tracking.sums import Numbers, PlaceSums, Sums, block_diagonal
from calibgraph.tracking.window import Window

_EXACT = 1e-4  # rad and m: what is stated of places to be smaller counts as nothing
_SETTLED = 50.0  # frames of a camera: an epoch more hardly changes their scatter
_ROUNDS = 2  # of estimates of the variance ratios, a fit after each
_OPEN_WEIGHINGS, _MOST_WEIGHINGS, _SAME_WEIGHT = 2, 20, 1e-2


class Spread(NamedTuple):
    """What the frames of each camera show of their errors, as ``calibgraph.solver.within_place``.

    Attributes:
        least: (n,) k, variance of matches of what they do not share, over that of independent ones.
        excess: (n, 6, 6) K - k.
        efficiency: (n,) of independent matches: their true variance over that of H, in the mean.
        cloud: (6, 6) covariance of the cloud at a place, as the matcher states it.
    """

    least: Array
    excess: Array
    efficiency: Array
    cloud: Array


def spread_of(state: State, sums: PlaceSums) -> Spread:
    """What the frames of each camera show of their errors, about the means of their places.

    With an allowance for few frames, as in a batch. Where the matcher states nothing of places it
    is wider if epochs scatter more than their frames suggest.
    """
    (scatter, left), every = sums.within_places, sums.rows.total()
    hessian, reweighted, frames = every.hessian, every.reweighted, every.frames
    n = len(frames)  # of those without any, as of independent matches
    least, excess, efficiency = np.ones(n), np.tile(1e-3 * np.eye(6), (n, 1, 1)), np.ones(n)
    if not states_places(state):
        wider = np.where(state.is_known, sure_inflation(state.groups), 1.0)
        scatter = scatter * wider[:, None, None]
    for camera in map(int, np.flatnonzero(frames)):
        true, matches = hessian[camera] + WEAK, every.matches[camera]
        own = allow_for_few_frames(
            scatter[camera], true, left[camera], frames=frames[camera], matches=matches
        )
        root = np.linalg.cholesky(reweighted[camera] + WEAK)
        covariance, efficiency[camera] = relative_covariance(own, root, true)
        least[camera], excess[camera] = split_excess(covariance)
    sizes = state.findings.place_rotation_rad, state.findings.place_translation_m
    return Spread(least, excess, efficiency, pose_covariance(*np.square(sizes)))


def states_places(state: State) -> bool:
    """Whether frames of one place share more than all frames do."""
    stated = state.findings
    sizes = stated.place_rotation_rad, stated.place_translation_m
    return stated.place_variance > 0 or max(sizes) > _EXACT


@dataclass(frozen=True, eq=False)
class Terms:
    """Some places: their matches, and the covariances of their displacements.

    Attributes:
        names: of the places.
        known: (P,) their rows among the places whose optimum is known, -1 of new ones.
        seen: (P, n) which cameras have matches there.
        information: (P, n, 6, 6) of the matches, zero where there are none.
        minimum: (P, n, 6) of the matches, from the references.
        at_place: (P, n, 6, 6) covariance of a camera's matches about its mean.
        cloud: (P, 6, 6) covariance of the cloud's displacement.
        robust_scale: tuning constant of the loss; infinite: none.
    """

    names: tuple[str, ...]
    known: Numbers
    seen: Mask
    information: Array
    minimum: Array
    at_place: Array
    cloud: Array
    robust_scale: float

    @staticmethod
    def of(state: State, sums: PlaceSums, rows: Sequence[int], spread: Spread) -> Terms:
        """Of some rows of the sums over all frames."""
        own, findings, prior = sums.rows[rows], state.findings, error_components()
        frames, places = own.frames, sums.places[rows]
        names, weighted = tuple(sums.names[row] for row in rows), own.reweighted + WEAK
        known = state.settled_rows(names)
        stated = findings.place_variance * spread.efficiency
        excess = spread.excess + (stated * frames / places)[..., None, None] * np.eye(6)
        seen, inverse = frames > 0, np.linalg.inv(np.linalg.cholesky(weighted))
        alike = np.where(seen, places, np.inf).min(axis=1)
        return Terms(
            names,
            known,
            seen,
            weighted * (seen / spread.least)[..., None, None],
            _minimum(state, own, known, weighted),
            state.ratios.cameras * (inverse.swapaxes(2, 3) @ excess @ inverse),
            state.ratios.cloud * spread.cloud / alike[:, None, None],
            prior.robust_sigmas if sums.count >= prior.robust_places else np.inf,
        )

    def eliminate(self, weights: Array, chain: Array) -> Eliminated:
        """The places without their poses, for (P, 1 + n) weights in the loss."""
        at_place = self.at_place / weights[:, 1:, None, None]
        pull = -(self.information @ self.minimum[..., None])[..., 0]
        hessian, gradient, cameras = soften(self.information, pull, at_place)
        by = chain.reshape(-1, 6, chain.shape[1])
        hessian = (by.swapaxes(1, 2) @ hessian @ by).sum(axis=1)
        gradient = gradient.reshape(-1, len(chain)) @ chain
        cloud = self.cloud / weights[:, :1, None]
        hessian, gradient, of_cloud = soften(hessian, gradient, cloud)
        return Eliminated(hessian.sum(axis=0), gradient.sum(axis=0), of_cloud, cameras, by)

    def squared(self, u: Array, v: Array) -> Array:
        """(P, 1 + n) squared sigmas of such displacements, in a loss that is not robust."""
        of_u = (u * np.linalg.solve(self.cloud, u[..., None])[..., 0]).sum(axis=-1)
        of_v = (v * np.linalg.solve(self.at_place, v[..., None])[..., 0]).sum(axis=-1)
        return np.column_stack([of_u, np.where(self.seen, of_v, 0.0)])

    def weigh(self, squared: Array) -> Array:
        """(P, 1 + n) weights of displacements by :meth:`squared`, in Geman and McClure's loss."""
        return np.asarray((1.0 + squared / self.robust_scale**2) ** -2)

    def known_weights(self, state: State) -> Array:
        """(P, 1 + n) weights at the optimum of the last epoch, 1 of new places."""
        weights, known = np.ones((len(self.names), 1 + self.seen.shape[1])), self.known >= 0
        if np.isfinite(self.robust_scale) and known.any():
            weights[known] = state.weights[self.known[known]]
        return weights

    def open_weights(self, state: State, chain: Array) -> Array:
        """The same while an epoch is open: of new places, from a non-robust start."""
        weights, new = self.known_weights(state), self.known < 0
        for _ in range(_OPEN_WEIGHINGS if np.isfinite(self.robust_scale) and new.any() else 0):
            found = self.eliminate(weights, chain)
            squared = self.squared(*found.displacements(state.shared))
            weights[new] = self.weigh(squared)[new]
        return weights


class Eliminated(NamedTuple):
    """Some places without their poses (``calibgraph.solver.places``).

    What is left is a quadratic in the steps of the cloud and of the cameras that all places share.
    It depends on them through r, where matches show the cameras.

    Attributes:
        hessian: (6 + 6 n, 6 + 6 n) sum over the places.
        gradient: (6 + 6 n,).
        cloud: (P, ...) displacements u of the clouds.
        cameras: (P, n, ...) displacements v of the cameras' matches, by their poses r - Ad u.
        by: (n, 6, 6 + 6 n) derivative of r.
    """

    hessian: Array
    gradient: Array
    cloud: Displacement
    cameras: Displacement
    by: Array

    def displacements(self, shown: Array) -> tuple[Array, Array]:
        """(P, 6) u and (P, n, 6) v where matches show the cameras at (n, 6) r."""
        u = self.cloud.step(np.concatenate([np.zeros(6), shown.ravel()]))
        there, of = self.at_places(shown, u, np.zeros(6)), self.cameras
        pull = (of.rows @ there[..., None])[..., 0] + of.pull
        return u, -(of.free @ pull[..., None])[..., 0]

    def at_places(self, shown: Array, u: Array, v: Array) -> Array:
        """(P, n, 6) where matches show the cameras at each place, so displaced."""
        return shown + v + np.asarray(self.by[:, :, :6] @ u[:, None, :, None])[..., 0]

    def open_freedom(self, shown: Array) -> tuple[Array, Array]:
        """(P,) and (P, n) degrees of freedom of u and v that the data leave open.

        With the (6 n, 6 n) covariance of r.
        """
        known = np.zeros_like(self.hessian)
        known[6:, 6:] = shown
        by_cloud = self.cameras.rows @ self.by[:, :, :6]
        moved = -self.cloud.free @ self.cloud.rows  # u by r
        rows = self.cameras.rows @ self.by + by_cloud @ moved[:, None]
        spread = by_cloud @ self.cloud.free[:, None] @ by_cloud.swapaxes(2, 3)
        cameras = self.cameras._replace(rows=rows, spread=spread)
        return self.cloud.open_freedom(known), cameras.open_freedom(known)


def _minimum(state: State, own: Sums, known: Numbers, weighted: Array) -> Array:
    """(P, n, 6) from the references to the minima of quadratics with the Hessian by weights.

    The gradient is that of the robust cost, by its true Hessian, where matches of the place show
    the cameras at the optimum of the last epoch; of a new place, at its own minimum.
    """
    at = np.concatenate([state.steps, np.zeros_like(own.gradient[:1])])[known]
    pull = own.gradient + (own.hessian @ at[..., None])[..., 0]
    by = np.where((known >= 0)[:, None, None, None], weighted, own.hessian + WEAK)
    return np.asarray(at - np.linalg.solve(by, pull[..., None])[..., 0])


@dataclass(frozen=True, eq=False)
class Estimate:
    """The optimum of the graph, and its marginal, until the next update.

    Attributes:
        T_camera_lidar: (n, 4, 4).
        covariance: (6 n, 6 n) of the reported poses; NaN for cameras with too few frames.
        sums: (n,) over all frames.
        conflicts: of relative poses with the correspondences, by their places in the rig.
        window: the graph of what all places share.
    """

    T_camera_lidar: Array
    covariance: Array
    sums: Sums
    conflicts: Mapping[int, Conflict]
    window: Window

    @property
    def contradicting(self) -> tuple[int, ...]:
        """Relative poses that contradict the correspondences, by their places in the rig."""
        limit = error_components().contradiction_sigmas
        return tuple(place for place, one in self.conflicts.items() if one.largest > limit)


class EpochGraph:
    """What stays the same until the end of an epoch.

    Args:
        state: with the closed epochs.
    """

    def __init__(self, state: State) -> None:
        self.references, self.findings = state.references, state.findings
        self.settled, self.contradicting = state.settled, state.contradicting
        self.rig = state.rig_at(state.references)
        self.sums = state.sums_before_epochs()[-2]
        self.places = state.places.add(state.at[: state.closed], state.sums[: state.closed])
        for camera in state.drifting:
            self.places = self.places.without(camera)
        frames = self.places.frames.sum(axis=0)
        self._is_settled = bool((frames[state.started] >= _SETTLED).all())
        self.spread = spread_of(state, self.places)
        out = {*state.dropped_pairs, *state.contradicting}  # by a move, or by the data
        pairs = tuple(p for place, p in enumerate(state.rig.relative_poses) if place not in out)
        rig, T = state.rig.model_copy(update={"relative_poses": pairs}), self.rig.T_camera_lidar
        self.pose_graph = objective_graph(rig, {}, T, state.config, terms="full")
        self.prior = pose_equations(self.pose_graph, state.names, T)
        travel = state.travel.reshape(-1, state.travel.shape[2])
        self._considered = block_diagonal(state.lens_errors) + travel @ travel.T
        self.window = self.new_window(state)
        self._held: dict[frozenset[str], tuple[Array, Array]] = {}

    def is_of(self, state: State) -> bool:
        """Whether the state is of the same epoch, with no change but more frames."""
        same = state.references is self.references and state.settled is self.settled
        same = same and state.findings is self.findings
        return same and state.contradicting == self.contradicting

    def equation_5(self, sums: Sums) -> Array:
        """(n, 6) from the references to the minimum of Eq. 5 of the paper."""
        hessian = block_diagonal(sums.hessian) + self.prior[0]
        pull = sums.gradient.ravel() + self.prior[1]
        return np.asarray(-np.linalg.solve(hessian, pull).reshape(-1, 6))

    def solve(self, state: State) -> Estimate:
        """The optimum and marginal with the frames of the open epoch.

        Raises:
            RuntimeError: by iSAM2, which is of no use then.
        """
        open_sums = state.sums[state.closed :]
        sums = self.sums + open_sums.total()
        every = every_place(state, self.places, sums)
        names = {*state.at[state.closed :], *state.at[-1:]}
        if not self._is_settled:  # that of all places changes with each frame
            self._held.clear()
            names |= {*every.names}
        rows = [row for row in every.visited if every.names[row] in names]
        own = Terms.of(state, every, rows, self.open_spread(state, every))
        touched = frozenset(own.names)
        if touched not in self._held:
            self._held[touched] = self._others(state, touched)
        hessian, gradient = self._held[touched]
        if own.names:
            found = own.eliminate(own.open_weights(state, self.window.chain), self.window.chain)
            hessian, gradient = hessian + found.hessian, gradient + found.gradient
            self._open = own, found
        self.window.exchange(hessian, gradient)
        T, covariance = self.window.reported(state.config.of)
        if state.config.preset != "auto":
            T = retract_all(state.references, self.equation_5(sums))
        unknown = np.where(sums.frames < ENOUGH_FRAMES, np.nan, 0.0).repeat(6)
        covariance = covariance + self._considered + np.add.outer(unknown, unknown)
        return Estimate(T, covariance, sums, self._conflicts(state, sums), self.window)

    def open_spread(self, state: State, every: PlaceSums) -> Spread:
        """That of all frames; of many, the open epoch hardly changes it."""
        return self.spread if self._is_settled else spread_of(state, every)

    def _others(self, state: State, touched: frozenset[str]) -> tuple[Array, Array]:
        """Hessian and gradient of the closed places but some."""
        names, size = self.places.names, self.window.chain.shape[1]
        rows = [row for row in self.places.visited if names[row] not in touched]
        if not rows:
            return np.zeros((size, size)), np.zeros(size)
        terms = Terms.of(state, self.places, rows, self.spread)
        return terms.eliminate(terms.known_weights(state), self.window.chain)[:2]

    def at_its_place(self, state: State) -> tuple[Array, Array]:
        """(1 + n,) squared sigmas of the displacements at the last frame's place.

        And (n, 4, 4) T_camera_lidar there.
        """
        self.solve(state)
        own, found = self._open
        row, shown = own.names.index(state.at[-1]), self.window.shown
        u, v = found.displacements(shown)
        steps = found.at_places(shown, u, v)[row]
        return own.squared(u, v)[row], retract_all(state.references, steps)

    def _conflicts(self, state: State, sums: Sums) -> dict[int, Conflict]:
        """Conflicts of the rig's relative poses with the correspondences alone, by their places.

        Of the graph, the priors of the mounts are left out.
        """
        if not state.rig.relative_poses:
            return {}
        enough = state.started & (sums.frames >= ENOUGH_FRAMES) & sums.are_determined
        names = state.names
        known = {names[camera]: camera for camera in np.flatnonzero(enough).tolist()}
        measured = {
            place: pair
            for place, pair in enumerate(state.rig.relative_poses)
            if place not in state.dropped_pairs and {pair.a, pair.b} <= known.keys()
        }
        if not measured:
            return {}
        keys = self.window.model.camera_keys
        information = np.linalg.inv(self.window.covariance(keys))
        vector = information @ self.window.steps(keys) + self.prior[1]
        information = information - self.prior[0] + np.diag(np.repeat(~enough, 6) * 1.0)
        covariance = np.asarray(np.linalg.inv(information))
        T = retract_all(state.references, (covariance @ vector).reshape(-1, 6))
        rows = rows_of(known.values())
        own = {name: T[camera] for name, camera in known.items()}
        return {
            place: relative_pose_conflict(pair, tuple(own), own, covariance[np.ix_(rows, rows)])
            for place, pair in measured.items()
        }

    def new_window(self, state: State) -> Window:
        """What all places share, by the present ratios."""
        findings, bends, n, spread = state.findings, state.bends, len(state.names), self.spread
        sigmas, shared = np.asarray(findings.bend_sigmas), state.ratios.shared
        size = len(sigmas)
        jacobian, shown, vector = np.zeros((n, 6, size)), np.zeros((size, size)), np.zeros(size)
        if any(findings.bend_sigmas):
            hessian, pulled = bends[:, :36].reshape(-1, 6, 6), bends[:, 36:54].reshape(-1, 6, size)
            jacobian = np.linalg.solve(hessian + WEAK, pulled) * sigmas
            within = spread.least + np.trace(spread.excess, axis1=1, axis2=2) / 6
            alike = findings.place_variance * spread.efficiency * self.places.alike
            weight = 1.0 / (within + alike)
            shown = np.outer(sigmas, sigmas) * (weight @ bends[:, 54:63]).reshape(size, size)
            vector = sigmas * (weight @ bends[:, 63:])
        each = np.tile(np.eye(6), (1, n, 1, 1))
        cloud, camera = common_error(findings.rigid_sigmas, findings.camera_share)
        components = VarianceComponents(
            cloud=shared * cloud,
            cloud_at_place=np.eye(6),
            camera=shared * camera,
            pairs=np.eye(6),
            at_place=each,
            scatter_at_place=each,
            distortion_jacobian=jacobian,
            pair_distortion_jacobian=np.zeros_like(jacobian),
            distortion_information=shown,
            distortion_vector=vector,
            distortion_size=shared,
        )
        model = SharedModel(state.names, {}, (), self.pose_graph, components, state.config.of)
        return Window(model, state.references)


@dataclass(frozen=True, eq=False)
class SharedModel(LatentPoseModel):
    """What all places share, of cameras whose matches are summed up."""

    @cached_property
    def matched(self) -> list[int]:
        """All cameras, by number."""
        return [*range(len(self.cameras))]


def every_place(state: State, closed: PlaceSums, sums: Sums) -> PlaceSums:
    """The sums at all places, of drifting cameras as if of the present place.

    Args:
        state: with the frames of the open epoch.
        closed: the sums of closed epochs.
        sums: (n,) over all frames.
    """
    every = closed.add(state.at[state.closed :], state.sums[state.closed :])
    for camera in state.drifting:
        every = every.with_camera_at(state.at[-1], camera, sums[camera])
    return every


def settle(state: State) -> EpochGraph:
    """Find optimum, weights and variance ratios of the closed epochs; the graph with these."""
    graph = EpochGraph(state)
    rows = graph.places.visited
    shows_ratios = len(rows) > 1 or bool(len(rows) and state.rig.relative_poses)
    for left in range(_ROUNDS if shows_ratios else 0, -1, -1):
        terms = Terms.of(state, graph.places, rows, graph.spread)
        fit = _fit(state, terms, graph.window)
        if not left:
            break
        evidence = _evidence(state, terms.seen, fit, graph.window)
        ratios = ratios_by_evidence(evidence, places=len(rows), present=state.ratios)
        if ratios.is_near(state.ratios):
            break
        state.ratios = ratios
        graph.window = graph.new_window(state)
    graph.settled = state.settled
    return graph


def locate_places(state: State, graph: EpochGraph) -> None:
    """Find the optimum of all places, those of the open epoch too, for the present ratios."""
    every = every_place(state, graph.places, state.all_sums())
    rows = every.visited
    if len(rows) > 1:
        _fit(state, Terms.of(state, every, rows, graph.spread), graph.window)


def _fit(state: State, terms: Terms, window: Window) -> tuple[Eliminated, Array]:
    """Find where matches show the cameras, at all places and at each, and the weights of these.

    In a robust loss, weights of new places start from 1.

    Returns:
        The places, eliminated; (P, 1 + n) their displacements, in squared sigmas.
    """
    weights = terms.known_weights(state)
    for _ in range(_MOST_WEIGHINGS):
        found = terms.eliminate(weights, window.chain)
        window.exchange(found.hessian, found.gradient)
        shown = window.shown
        u, v = found.displacements(shown)
        squared = terms.squared(u, v)
        new = terms.weigh(squared)  # 1 in a loss that is not robust
        if not new.size or np.abs(new - weights).max() < _SAME_WEIGHT:
            break
        weights = new
    state.settled, state.weights, state.shared = terms.names, weights, shown
    state.steps = found.at_places(shown, u, v)
    return found, squared


def _evidence(
    state: State, seen: Mask, fit: tuple[Eliminated, Array], window: Window
) -> dict[Component, Evidence]:
    """Per component its weighted sum of squares, and what of its freedom the data determine."""
    weights, squared = state.weights, state.weights * fit[1]
    open_u, open_v = fit[0].open_freedom(window.covariance_of_shown)
    present, parts = weights[:, 1:][seen], window.model.components
    model, known, distortions = window.model, 0.0, 0
    if model.is_distorted:  # its residuals count as a part of its prior
        distortions, known = parts.distortion_jacobian.shape[2], least_cost_of_distortion(parts)
    variables = 6.0 * (1 + len(model.cameras)) + distortions
    shared = window.squared_errors - known
    return {
        "shared": Evidence(shared, variables - window.undetermined()),
        "cloud": Evidence(squared[:, 0].sum(), 6.0 * weights[:, 0].sum() - open_u.sum()),
        "cameras": Evidence(squared[:, 1:].sum(), 6.0 * present.sum() - open_v[seen].sum()),
    }
