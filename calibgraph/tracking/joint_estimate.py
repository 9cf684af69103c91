"""The estimate of all cameras and its covariance, by the error model, in constant time.

The tracker's own estimate takes all matches for independent: by it frames are gated and moves are
found. What is reported is the minimum under the error model, as of a batch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.graph.objective import relative_pose_graph
from calibgraph.model.error_components import error_components
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.geometry import pose_rows, to_T_camera_lidar
from calibgraph.solver.conflicts import Conflict, relative_pose_conflict
from calibgraph.solver.covariance import ENOUGH_FRAMES, with_pseudo_frames
from calibgraph.solver.curvature import convex_hessian, pose_equations
from calibgraph.tracking.place_errors import (
    FrameSpread,
    Information,
    PlaceTerms,
    SharedErrors,
    root_of,
    spread_over,
)
from calibgraph.tracking.place_sizes import sizes_shown
from calibgraph.tracking.place_sums import PlaceSums, parts_of
from calibgraph.tracking.posterior import Posterior, is_determined, steps_of
from calibgraph.tracking.state import State
from calibgraph.tracking.window import pose_priors

Array = NDArray[np.float64]

_PRIOR_FRAMES = 10.0  # weight of the scatter of all frames so far, while a moved camera has few
_SETTLED = 50.0  # frames of a camera: an epoch more hardly changes their scatter
_ROUNDS = 3  # of sizing, as in a batch
_POSE = 6


@dataclass(frozen=True, eq=False)
class Priors:
    """Quadratics of the terms without correspondences, at the references.

    Attributes:
        always: (6 n, 6 n) Hessian of the priors, which are about the references.
        measured: per relative pose, by its place in the rig: (6 n, 6 n) Hessian, (6 n,) gradient.
    """

    always: Array
    measured: dict[int, tuple[Array, Array]]

    @staticmethod
    def of(state: State) -> Priors:
        """Of the priors, and of the relative poses that no move has invalidated."""
        T = _by_name(state, state.references)
        measured = {
            place: pose_equations(relative_pose_graph(state.names, (pair,)), state.names, T)
            for place, pair in enumerate(state.rig.relative_poses)
            if place not in state.dropped_pairs
        }
        whole = pose_equations(pose_priors(state), state.names, T)[0]
        return Priors(whole - sum(hessian for hessian, _ in measured.values()), measured)

    def without(self, conflicts: Mapping[int, Conflict]) -> Information:
        """All but the relative poses that contradict the correspondences."""
        limit = error_components().contradiction_sigmas
        matrix, vector = self.always, np.zeros(len(self.always))
        for place, (hessian, gradient) in self.measured.items():
            if place not in conflicts or conflicts[place].largest <= limit:
                matrix, vector = matrix + hessian, vector - gradient
        return Information(matrix, vector)


@dataclass(frozen=True, eq=False)
class ClosedPlaces:
    """The sums over the frames of closed epochs, and what follows from these.

    Attributes:
        sums: per place; of a camera that drifts, none.
        findings: with which the rest was made.
        errors: what frames share, of the bends what is usual.
        seen: by the frames of each camera.
        terms: of each place.
    """

    sums: PlaceSums
    findings: MatcherFindings
    errors: SharedErrors
    seen: FrameSpread
    terms: PlaceTerms

    def is_settled(self, state: State) -> bool:
        """Whether an epoch's frames more would hardly change the scatter of frames."""
        frames = self.sums.frames.sum(axis=0)
        cameras = zip(state.cameras, frames, strict=True)
        return all(count >= _SETTLED for one, count in cameras if one.started)

    @staticmethod
    def of(state: State) -> ClosedPlaces:
        """Of a state's closed epochs."""
        frames = [frame for epoch in state.epochs[:-1] for frame in epoch.frames]
        sums = state.places.add(parts_of(frames, steps_of(state)))
        for camera, one in enumerate(state.cameras):
            if one.summary.walk:
                sums = sums.without(camera)
        shifts = state.all_bends.shifts
        errors = SharedErrors.of(state.findings, state.references, state.sizes, shifts)
        every = np.ones(len(sums.names), dtype=np.bool_)
        seen = _spreads(state, sums, errors)
        terms = PlaceTerms.of(sums, every, seen, errors)
        return ClosedPlaces(sums, state.findings, errors, seen, terms)

    @cached_property
    def information(self) -> Information:
        """Of each place."""
        return self.terms.information

    def errors_shown(self, state: State, places: PlaceSums, seen: FrameSpread) -> SharedErrors:
        """The errors with what residuals show of the bends, but with a preset of the paper."""
        if state.config.preset != "auto":
            return self.errors
        variance = seen.mean_variance(places, state.findings.place_variance)
        return self.errors.with_residuals(state.all_bends, variance)


@dataclass(frozen=True, eq=False)
class JointEstimate:
    """All cameras' estimates.

    Attributes:
        T_lidar_camera: per camera.
        covariance: (6 n, 6 n) of xi in T_camera_lidar = exp(xi) estimate; NaN for cameras with too
            few frames.
        conflicts: of the relative poses with the correspondences of both their cameras.
    """

    T_lidar_camera: tuple[gtsam.Pose3, ...]
    covariance: Array
    conflicts: tuple[Conflict, ...]


def joint_estimate(
    state: State, sums: Posterior, closed: ClosedPlaces, priors: Priors
) -> JointEstimate:
    """The present estimates.

    A relative pose that contradicts the correspondences of both its cameras takes no part, as in a
    batch.

    Args:
        state: the tracker's.
        sums: over its summaries and live frames.
        closed: of its closed epochs.
        priors: at its references.
    """
    if closed.findings != state.findings:
        closed = ClosedPlaces.of(state)
    places = _with_open_epoch(state, sums, closed)
    seen = closed.seen if closed.is_settled(state) else _spreads(state, places, closed.errors)
    errors = closed.errors_shown(state, places, seen)
    own = _information(state, places, closed, seen).of_cameras(errors)
    conflicts = _conflicts(state, places, own)
    agreeing = own + priors.without(conflicts)
    covariance = np.asarray(np.linalg.inv(agreeing.matrix), dtype=np.float64)
    estimates = state.T_lidar_camera
    several = priors.measured or errors.bend_mean.any() or not places.is_of_one_place
    if state.config.preset == "auto" and several:
        steps = (covariance @ agreeing.vector).reshape(-1, _POSE)
        moved = zip(state.references, steps, strict=True)
        estimates = tuple(reference.retract(step) for reference, step in moved)
    few = np.repeat(sums.frames < ENOUGH_FRAMES, _POSE)
    covariance[few], covariance[:, few] = np.nan, np.nan
    return JointEstimate(estimates, covariance, tuple(conflicts.values()))


def with_sizes(state: State) -> State:
    """The state with the sizes of the errors that its closed epochs show."""
    sizes, priors = state.sizes, Priors.of(state)
    for _ in range(_ROUNDS):
        closed = ClosedPlaces.of(replace(state, sizes=sizes))
        if closed.sums.is_of_one_place and not priors.measured:
            return state
        every = np.ones(len(closed.sums.names), dtype=np.bool_)
        errors = closed.errors_shown(state, closed.sums, closed.seen)
        own = closed.information.sum(every).of_cameras(errors)
        of_poses = priors.without(_conflicts(state, closed.sums, own))
        found = sizes_shown(closed.sums, closed.terms, errors, of_poses, sizes)
        if found.is_near(sizes):
            break
        sizes = found
    return replace(state, sizes=sizes)


def _with_open_epoch(state: State, sums: Posterior, closed: ClosedPlaces) -> PlaceSums:
    """The sums over all frames; those of a camera that drifts at the present place."""
    frames = state.epochs[-1].frames
    places = closed.sums.add(parts_of(frames, steps_of(state)))
    live = state.live_frames
    for camera, one in enumerate(state.cameras):
        if one.summary.walk and live:
            rows = pose_rows(camera)
            own = (
                sums.hessian[camera],
                sums.gradient[camera],
                sums.scatter[rows, rows],
                float(sums.frames[camera]),
            )
            used = state.matches_of_frame(camera)
            places = places.with_camera_at(live[-1].place, camera, own, used)
    return places if state.config.preset == "auto" else places.bounded(most=0)


def _information(
    state: State, places: PlaceSums, closed: ClosedPlaces, seen: FrameSpread
) -> Information:
    """Of all places: those that the open epoch adds to are computed anew."""
    if len(places.names) == 1:  # the weights of a preset of the paper
        every = np.ones(1, dtype=np.bool_)
        return PlaceTerms.of(places, every, seen, closed.errors).information.sum(every)
    live = state.live_frames[-1:]
    touched = {frame.place for frame in (*state.epochs[-1].frames, *live)}
    fresh = np.array([name in touched for name in places.names])
    kept = np.array([name not in touched for name in closed.sums.names])
    present = PlaceTerms.of(places, fresh, seen, closed.errors).information
    return closed.information.sum(kept) + present.sum(np.ones(len(present.vector), np.bool_))


def _spreads(state: State, places: PlaceSums, errors: SharedErrors) -> FrameSpread:
    """Of each camera's frames about the means of their places.

    With an allowance for few frames, as in a batch. While a camera that has moved has few frames,
    the scatter is shrunk towards that of all its frames so far. Where the matcher states nothing of
    places it is wider if epochs scatter more than their frames suggest.
    """
    scatter, frames, left = places.of_all
    matches = places.matches.sum(axis=0)
    hessian, reweighted = places.hessian.sum(axis=0), places.reweighted.sum(axis=0)
    roots, spreads = np.tile(np.eye(_POSE), (2, len(frames), 1, 1))
    correlation = error_components().frame_correlation
    for camera in np.flatnonzero(frames):
        count, seen = frames[camera], left[camera] + 1.0
        own = _usual_while_few(state, int(camera), scatter[camera], count)
        if not errors.are_at_places:
            own = state.widen(int(camera), own)
        true = convex_hessian(hessian[camera], reweighted[camera])
        root = root_of(reweighted[camera], true)
        usual_size = 1.0 + correlation * (matches[camera] / count - 1.0)
        usual = usual_size * true * seen / count
        whole = with_pseudo_frames(own, true, np.full(_POSE, seen), usual) * count / seen
        roots[camera], spreads[camera] = root, spread_over(whole, reweighted[camera], root)
    return FrameSpread(roots, spreads)


def _usual_while_few(state: State, camera: int, scatter: Array, frames: float) -> Array:
    """(6, 6) scatter of a camera's frames, that of all before counted in after a move."""
    one = state.cameras[camera]
    if one.moved_at < 0 or one.summary.walk:
        return scatter
    share, rows = _PRIOR_FRAMES / (frames + _PRIOR_FRAMES), pose_rows(camera)
    usual = state.total[rows, rows] * (frames / max(state.total_frames[camera], 1.0))
    return np.asarray((1.0 - share) * scatter + share * usual)


def _conflicts(state: State, places: PlaceSums, own: Information) -> dict[int, Conflict]:
    """Conflicts between the rig's relative poses and the correspondences, by place in the rig."""
    if not state.rig.relative_poses:
        return {}
    frames, hessian = places.frames.sum(axis=0), places.hessian.sum(axis=0)
    known = [
        camera
        for camera, one in enumerate(state.cameras)
        if one.started and frames[camera] >= ENOUGH_FRAMES and is_determined(hessian[camera])
    ]
    rows = (_POSE * np.array(known, dtype=np.intp)[:, None] + np.arange(_POSE)).ravel()
    covariance = np.asarray(np.linalg.inv(own.matrix[np.ix_(rows, rows)]), dtype=np.float64)
    steps = (covariance @ own.vector[rows]).reshape(-1, _POSE)
    T = {
        state.names[c]: to_T_camera_lidar(state.references[c].retract(step))
        for c, step in zip(known, steps, strict=True)
    }
    return {
        place: relative_pose_conflict(pair, tuple(T), T, covariance)
        for place, pair in enumerate(state.rig.relative_poses)
        if place not in state.dropped_pairs and {pair.a, pair.b} <= set(T)
    }


def _by_name(state: State, poses: tuple[gtsam.Pose3, ...]) -> dict[str, Array]:
    return {n: to_T_camera_lidar(pose) for n, pose in zip(state.names, poses, strict=True)}
