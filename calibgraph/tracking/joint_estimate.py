"""The estimate of all cameras and its covariance: optimum and marginal of the error model's graph.

The tracker's own estimate takes all matches for independent: by it frames are gated and moves are
found. What is reported is the minimum under the error model, as of a batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.graph.latent_poses import LatentPoseModel
from calibgraph.graph.objective import join
from calibgraph.graph.variables import (
    CLOUD,
    DISTORTION,
    camera_key,
    cloud_at_key,
    matched_at_key,
    matched_key,
)
from calibgraph.model.error_components import error_components
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.geometry import pose_rows, to_T_camera_lidar
from calibgraph.solver.conflicts import Conflict, relative_pose_conflict
from calibgraph.solver.covariance import ENOUGH_FRAMES
from calibgraph.solver.elimination import (
    LatentPoseFit,
    Linearization,
    fit_latent_poses,
    start_values,
)
from calibgraph.solver.error_model import held_graph
from calibgraph.solver.variance_components import estimate_variance_ratios
from calibgraph.tracking.place_model import (
    FrameSpread,
    marginals_of_places,
    place_model,
    summary_factor,
)
from calibgraph.tracking.place_sums import PlaceSums, parts_of
from calibgraph.tracking.posterior import Posterior, is_determined, steps_of
from calibgraph.tracking.state import State
from calibgraph.tracking.window import pose_priors

Array = NDArray[np.float64]
Conflicts = dict[int, Conflict]
Rows = tuple[int, ...]

NO_ROWS: Rows = ()

_SETTLED = 50.0  # frames of a camera: an epoch more hardly changes their scatter
_ROUNDS = 3  # of fits and estimates of the variance ratios, as in a batch
_TOLERANCE = 1e-3  # relative change of the cost, of which the residuals of matches are no part


@dataclass(frozen=True, eq=False)
class ClosedPlaces:
    """The sums over the frames of closed epochs, and the optimum of their graph.

    Attributes:
        sums: per place; of a camera that drifts, none.
        findings: with which the rest was made.
        seen: by the frames of each camera.
        rows: of ``sums``, the places of the graph.
        fit: its optimum.
    """

    sums: PlaceSums
    findings: MatcherFindings
    seen: FrameSpread
    rows: Rows
    fit: LatentPoseFit
    _summaries: dict[Rows, gtsam.NonlinearFactorGraph] = field(default_factory=dict)
    _pose_graphs: dict[Rows, gtsam.NonlinearFactorGraph] = field(default_factory=dict)

    @staticmethod
    def of(state: State) -> ClosedPlaces:
        """Of a state's closed epochs."""
        frames = [frame for epoch in state.epochs[:-1] for frame in epoch.frames]
        sums = state.places.add(parts_of(frames, steps_of(state)))
        for camera, one in enumerate(state.cameras):
            if one.summary.walk:
                sums = sums.without(camera)
        seen = FrameSpread.of(state, sums)
        rows = tuple(int(row) for row in np.flatnonzero(sums.frames.any(axis=1)))
        model = place_model(state, sums, seen, rows)
        values = start_values(model, _by_name(state))
        pose_graphs = {NO_ROWS: pose_priors(state)}
        fit, _ = _fit(state, sums, model, values, pose_graphs=pose_graphs)
        return ClosedPlaces(sums, state.findings, seen, rows, fit, _pose_graphs=pose_graphs)

    @cached_property
    def marginals(self) -> list[gtsam.GaussianFactorGraph]:
        """Per place, on what all places share."""
        return marginals_of_places(self.fit)

    def is_settled(self, state: State) -> bool:
        """Whether an epoch's frames more would hardly change the scatter of frames."""
        frames = self.sums.frames.sum(axis=0)
        cameras = zip(state.cameras, frames, strict=True)
        return all(count >= _SETTLED for one, count in cameras if one.started)

    def fit_with(
        self, state: State, places: PlaceSums, seen: FrameSpread
    ) -> tuple[LatentPoseFit, Conflicts]:
        """The optimum with the frames of the open epoch, and the relative poses that contradict.

        Args:
            state: of the tracker.
            places: sums of all frames.
            seen: by the frames of each camera.
        """
        live = state.live_frames[-1:]
        touched = {frame.place for frame in (*state.epochs[-1].frames, *live)}
        names, kept = self.sums.names, NO_ROWS
        if len(places.names) == 1:  # the weights of a preset of the paper
            touched = set(places.names)
        else:
            kept = tuple(i for i, row in enumerate(self.rows) if names[row] not in touched)
        present = np.flatnonzero(places.frames.any(axis=1))
        rows = [int(row) for row in present if places.names[row] in touched]
        if not rows and kept:  # the scan distortion needs a place
            kept, rows = kept[:-1], [places.names.index(names[self.rows[kept[-1]]])]
        if kept not in self._summaries:
            chosen = [self.marginals[i] for i in kept]
            self._summaries[kept] = summary_factor(chosen, self.fit.linear.values)
        model = place_model(state, places, seen, rows)
        model = replace(model, pose_graph=self._summaries[kept])
        values = self._start(state, model)
        return _fit(state, places, model, values, pose_graphs=self._pose_graphs)

    def _start(self, state: State, model: LatentPoseModel) -> gtsam.Values:
        """What all places share as at the optimum, the places where they are expected by it."""
        values, closed = start_values(model, _by_name(state)), self.fit.linear.values
        for key in model.shared_keys:
            if closed.exists(key) and key != DISTORTION:
                values.update(key, closed.atPose3(key))
        if model.is_distorted and closed.exists(DISTORTION):
            values.update(DISTORTION, closed.atVector(DISTORTION))
        for place, camera in model.matched_places():
            values.update(matched_at_key(place, camera), values.atPose3(matched_key(camera)))
        cloud = values.atPose3(CLOUD)
        for place in range(model.places):
            values.update(cloud_at_key(place), cloud)
        return values


@dataclass(frozen=True, eq=False)
class JointEstimate:
    """All cameras' estimates.

    Attributes:
        T_lidar_camera: per camera.
        covariance: (6 n, 6 n) of xi in T_camera_lidar = exp(xi) estimate; NaN for cameras with too
            few frames.
        conflicts: of the relative poses with the correspondences of both their cameras.
        fit: the graph at its optimum.
    """

    T_lidar_camera: tuple[gtsam.Pose3, ...]
    covariance: Array
    conflicts: tuple[Conflict, ...]
    fit: LatentPoseFit


def joint_estimate(state: State, sums: Posterior, closed: ClosedPlaces) -> JointEstimate:
    """The present estimates.

    A relative pose that contradicts the correspondences of both its cameras takes no part, as in a
    batch.

    Args:
        state: the tracker's.
        sums: over its summaries and live frames.
        closed: of its closed epochs.
    """
    if closed.findings != state.findings:
        closed = ClosedPlaces.of(state)
    places = _with_open_epoch(state, sums, closed)
    seen = closed.seen if closed.is_settled(state) else FrameSpread.of(state, places)
    fit, conflicts = closed.fit_with(state, places, seen)
    estimates = state.T_lidar_camera
    shown = fit.linear.model.components.distortion_vector.any()
    several = state.rig.relative_poses or shown or not places.is_of_one_place
    if state.config.preset == "auto" and several:
        estimates = fit.T_lidar_camera
    covariance, few = fit.covariance.copy(), np.repeat(sums.frames < ENOUGH_FRAMES, 6)
    covariance[few], covariance[:, few] = np.nan, np.nan
    return JointEstimate(estimates, covariance, tuple(conflicts.values()), fit)


def with_sizes(state: State) -> State:
    """The state with the variance ratios that its closed epochs show."""
    for _ in range(_ROUNDS):
        closed = ClosedPlaces.of(state)
        if closed.sums.is_of_one_place and not state.rig.relative_poses:
            return state
        found = estimate_variance_ratios(closed.fit, state.sizes)
        if found.is_near(state.sizes):
            break
        state = replace(state, sizes=found)
    return state


def _fit(
    state: State,
    sums: PlaceSums,
    model: LatentPoseModel,
    values: gtsam.Values,
    *,
    pose_graphs: dict[Rows, gtsam.NonlinearFactorGraph],
) -> tuple[LatentPoseFit, Conflicts]:
    """The optimum with priors and relative poses, and the conflicts of these with the data.

    Args:
        state: of the tracker.
        sums: of all frames.
        model: with the places, and the summary of others.
        values: near the optimum.
        pose_graphs: the priors without contradicting relative poses, by their places in the rig.
    """
    conflicts = _conflicts(state, sums, model, values)
    limit = error_components().contradiction_sigmas
    dropped = tuple(place for place, one in conflicts.items() if one.largest > limit)
    if dropped not in pose_graphs:
        without = tuple(sorted({*state.dropped_pairs, *dropped}))
        pose_graphs[dropped] = pose_priors(replace(state, dropped_pairs=without))
    model = replace(model, pose_graph=join(pose_graphs[dropped], model.pose_graph))
    fit = fit_latent_poses(model, values, relative_tolerance=_TOLERANCE)
    if fit is None:
        raise RuntimeError("a direction of a camera is not determined")
    return fit, conflicts


def _conflicts(
    state: State, sums: PlaceSums, model: LatentPoseModel, values: gtsam.Values
) -> Conflicts:
    """Conflicts between the rig's relative poses and the correspondences, by place in the rig."""
    frames, hessian = sums.frames.sum(axis=0), sums.hessian.sum(axis=0)
    known = [
        camera
        for camera, one in enumerate(state.cameras)
        if one.started and frames[camera] >= ENOUGH_FRAMES and is_determined(hessian[camera])
    ]
    names = [state.names[camera] for camera in known]
    measured = {
        place: pair
        for place, pair in enumerate(state.rig.relative_poses)
        if place not in state.dropped_pairs and {pair.a, pair.b} <= set(names)
    }
    if not measured:
        return {}
    others = [name for name in state.names if name not in names]
    held = held_graph(state.names, _by_name(state), others)
    mounts = replace(model, pose_graph=join(held, model.pose_graph), of="mount")
    linear = Linearization.at(mounts, values)
    found, rows = linear.values.retract(linear.step), _rows(known)
    covariance = linear.covariance[np.ix_(rows, rows)]
    T = {
        name: to_T_camera_lidar(found.atPose3(camera_key(camera)))
        for name, camera in zip(names, known, strict=True)
    }
    return {
        place: relative_pose_conflict(pair, tuple(T), T, covariance)
        for place, pair in measured.items()
    }


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


def _rows(cameras: Sequence[int]) -> NDArray[np.intp]:
    return np.add.outer(6 * np.asarray(cameras, dtype=np.intp), np.arange(6)).ravel()


def _by_name(state: State) -> dict[str, Array]:
    """Per camera its (4, 4) reference."""
    poses = zip(state.names, state.references, strict=True)
    return {name: to_T_camera_lidar(pose) for name, pose in poses}
