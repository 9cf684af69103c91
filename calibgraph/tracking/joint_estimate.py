"""The estimate of all cameras and its covariance: optimum and marginal of the error model's graph.

Frames are gated, and moves are found, at another estimate (``calibgraph.tracking.window``).

Between the ends of epochs the places that no frame of the open epoch is of keep the weights that
their robust loss has at the optimum of the last one: within 0.02 sigma that is the whole graph.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.graph.latent_poses import LatentPoseModel
from calibgraph.graph.linear_data import poses_of
from calibgraph.graph.variables import cloud_at_key, matched_at_key
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.geometry import (
    invert_each,
    to_T_lidar_camera,
)
from calibgraph.solver.conflicts import Conflict
from calibgraph.solver.covariance import ENOUGH_FRAMES
from calibgraph.solver.elimination import (
    LatentPoseFit,
    Linearization,
    start_values,
)
from calibgraph.solver.variance_components import VarianceRatios, estimate_variance_ratios
from calibgraph.tracking.contradictions import (
    Conflicts,
    Rows,
    fit_without_contradictions,
    poses_by_name,
    with_pose_graph,
)
from calibgraph.tracking.optimum import Optimum
from calibgraph.tracking.place_model import (
    FrameSpread,
    PlaceData,
    marginals_of_places,
    place_model,
    summary_factor,
)
from calibgraph.tracking.place_sums import PlaceSums, sums_by_place
from calibgraph.tracking.state import State
from calibgraph.tracking.sums import Sums, step_between
from calibgraph.tracking.window import pose_priors

Array = NDArray[np.float64]

NO_ROWS: Rows = ()

_SETTLED = 50.0  # frames of a camera: an epoch more hardly changes their scatter
STEPS = 5  # fits, and estimates of the variance ratios between them


@dataclass(frozen=True, eq=False)
class ClosedPlaces:
    """The frames of closed epochs, and the graph of their places.

    Attributes:
        sums: per place; of a camera that drifts, none.
        linear: the same, linearized at the pose that each place has there.
        findings: with which the rest was made.
        seen: by the frames of each camera.
        data: of the places of the graph.
        fit: the graph near its optimum.
        contradicting: places in ``rig.relative_poses`` of those that take no part.
        pose_graphs: the priors, without some relative poses.
        sizes: the variance ratios of the graph.
    """

    sums: PlaceSums
    linear: PlaceSums
    findings: MatcherFindings
    seen: FrameSpread
    data: PlaceData
    fit: LatentPoseFit
    contradicting: Rows
    pose_graphs: dict[Rows, gtsam.NonlinearFactorGraph]
    sizes: VarianceRatios
    _summaries: dict[Rows, gtsam.NonlinearFactorGraph] = field(default_factory=dict)

    @staticmethod
    def of(state: State) -> ClosedPlaces:
        """Of a state's closed epochs, at the optimum that the state has, or else fitted."""
        frames = [frame for epoch in state.epochs[:-1] for frame in epoch.frames]
        sums, earlier = state.places.add(sums_by_place(frames)), state.places
        for camera, one in enumerate(state.cameras):
            if one.summary.walk:
                sums, earlier = sums.without(camera), earlier.without(camera)
        seen = FrameSpread.of(state, sums)
        rows = {sums.names[row]: int(row) for row in np.flatnonzero(sums.frames.any(axis=1))}
        data = PlaceData.of(state, earlier, frames, rows)
        model = place_model(state, sums, seen, data)
        pose_graphs = {NO_ROWS: pose_priors(state)}
        values = _start(state, model, data.names)
        if state.optimum is None:
            fit, dropped, _ = fit_without_contradictions(
                state, sums, model, values, pose_graphs=pose_graphs
            )
        else:
            dropped = state.optimum.contradicting
            model = with_pose_graph(state, model, dropped, pose_graphs)
            fit = LatentPoseFit(Linearization.at(model, values), 0, True)
        linear = linearized(state, sums, data, fit)
        return ClosedPlaces(
            sums, linear, state.findings, seen, data, fit, dropped, pose_graphs, state.sizes
        )

    def fitted(self, state: State) -> ClosedPlaces:
        """At the optimum for the variance ratios of the state."""
        model = place_model(state, self.sums, self.seen, self.data)
        fit, dropped, _ = fit_without_contradictions(
            state, self.sums, model, self.fit.linear.values, pose_graphs=self.pose_graphs
        )
        linear = linearized(state, self.sums, self.data, fit)
        return ClosedPlaces(
            self.sums, linear, self.findings, self.seen, self.data, fit, dropped,
            self.pose_graphs, state.sizes,
        )  # fmt: skip

    @property
    def optimum(self) -> Optimum:
        """The poses there."""
        linear = self.fit.linear
        return Optimum.of(linear.model, linear.values, self.data.names, self.contradicting)

    @cached_property
    def marginals(self) -> list[gtsam.GaussianFactorGraph]:
        """Per place, on what all places share."""
        return marginals_of_places(self.fit)

    def shows_ratios(self, state: State) -> bool:
        """Whether anything is measured twice."""
        return not self.sums.is_of_one_place or bool(state.rig.relative_poses)

    def is_settled(self, state: State) -> bool:
        """Whether an epoch's frames more would hardly change the scatter of frames."""
        frames = self.sums.frames.sum(axis=0)
        cameras = zip(state.cameras, frames, strict=True)
        return all(count >= _SETTLED for one, count in cameras if one.started)

    def fit_with(self, state: State, sums: Sums) -> tuple[LatentPoseFit, Conflicts]:
        """The optimum with the frames of the open epoch, and the relative poses that contradict.

        Args:
            state: of the tracker.
            sums: over its summaries and live frames.
        """
        frames = state.epochs[-1].frames
        every = self.sums.add(sums_by_place(frames))
        every, earlier = (_with_drifting(state, sums, own) for own in (every, self.linear))
        seen = self.seen if self.is_settled(state) else FrameSpread.of(state, every)
        if state.config.preset == "auto":
            kept, rows = self._split(every, {f.place for f in (*frames, *state.live_frames[-1:])})
        else:  # the weights of a preset of the paper
            earlier = every = every.bounded(most=0)
            frames, kept, rows = (), NO_ROWS, [0] if every.frames.any() else []
        if kept not in self._summaries:
            chosen = [self.marginals[i] for i in kept]
            self._summaries[kept] = summary_factor(chosen, self.fit.linear.values)
        data = PlaceData.of(state, earlier, frames, {every.names[row]: row for row in rows})
        model = place_model(state, every, seen, data)
        model = replace(model, pose_graph=self._summaries[kept])
        values = _start(state, model, data.names)
        fit, _, conflicts = fit_without_contradictions(
            state, every, model, values, pose_graphs=self.pose_graphs
        )
        return fit, conflicts

    def _split(self, every: PlaceSums, touched: set[str]) -> tuple[Rows, list[int]]:
        """Which of the closed places a summary stands for, and the rows of the other places."""
        names, present = self.data.names, np.flatnonzero(every.frames.any(axis=1))
        kept = tuple(i for i, name in enumerate(names) if name not in touched)
        rows = [int(row) for row in present if every.names[row] in touched]
        if not rows and kept:  # the scan distortion needs a place
            kept, rows = kept[:-1], [every.names.index(names[kept[-1]])]
        return kept, rows


def linearized(state: State, sums: PlaceSums, data: PlaceData, fit: LatentPoseFit) -> PlaceSums:
    """The sums with the quadratics that all matches have at the pose of their place in a fit."""
    gradient, reweighted = np.zeros_like(sums.rows.gradient), np.zeros_like(sums.rows.reweighted)
    values, count = fit.linear.values, len(data.rows)
    clouds = poses_of(values, map(cloud_at_key, range(count)))
    for camera, matches in data.cameras.items():
        places, T_camera_cloud = matches.places, np.tile(np.eye(4), (count, 1, 1))
        keys = [matched_at_key(int(place), camera) for place in places]
        T_camera_cloud[places] = invert_each(poses_of(values, keys)) @ clouds[places]
        here = matches.sums(T_camera_cloud)
        for place, row in zip(places, data.rows[places], strict=True):
            pose = to_T_lidar_camera(T_camera_cloud[place])
            step = step_between(pose, state.references[camera])
            reweighted[row, camera] = here.hessian[place]
            gradient[row, camera] = here.gradient[place] + here.hessian[place] @ step
    rows = replace(sums.rows, hessian=reweighted, gradient=gradient, reweighted=reweighted)
    return replace(sums, rows=rows)


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


def joint_estimate(state: State, sums: Sums, closed: ClosedPlaces) -> JointEstimate:
    """The present estimates.

    A relative pose that contradicts the correspondences of both its cameras takes no part, as in a
    batch.

    Args:
        state: the tracker's.
        sums: over its summaries and live frames.
        closed: of its closed epochs.
    """
    fit, conflicts = closed.fit_with(state, sums)
    estimates = fit.T_lidar_camera if state.config.preset == "auto" else state.T_lidar_camera
    covariance, few = fit.covariance.copy(), np.repeat(sums.frames < ENOUGH_FRAMES, 6)
    covariance[few], covariance[:, few] = np.nan, np.nan
    return JointEstimate(estimates, covariance, tuple(conflicts.values()), fit)


def settle(state: State) -> State:
    """The state with optimum and variance ratios of its closed epochs, while these are few.

    Later an epoch changes little, and the frames after it do the work step by step.
    """
    closed = ClosedPlaces.of(state)
    if not closed.is_settled(state):
        for step in range(1, STEPS + 1):
            state, closed = refine(state, closed, step)
    return state


def refine(state: State, closed: ClosedPlaces, step: int) -> tuple[State, ClosedPlaces]:
    """One step towards optimum and variance ratios of the closed epochs.

    The first is a fit, the second an estimate of the ratios; and so again while these change. The
    next epoch goes on from there.
    """
    if step % 2:
        if step == 1 or closed.sizes != state.sizes:
            closed = closed.fitted(state)
            state = replace(state, optimum=closed.optimum)
    elif closed.sizes == state.sizes and closed.shows_ratios(state):
        found = estimate_variance_ratios(closed.fit, state.sizes)
        if not found.is_near(state.sizes):
            state = replace(state, sizes=found)
    return state, closed


def _start(state: State, model: LatentPoseModel, names: Sequence[str]) -> gtsam.Values:
    """Values near the optimum of a model, of places of these names."""
    if state.optimum is None:
        return start_values(model, poses_by_name(state))
    return state.optimum.values(model, names, state.references)


def _with_drifting(state: State, sums: Sums, places: PlaceSums) -> PlaceSums:
    """The sums of places, with those of cameras that drift at the present one."""
    live = state.live_frames
    for camera, one in enumerate(state.cameras):
        if one.summary.walk and live:
            places = places.with_camera_at(live[-1].place, camera, sums[camera])
    return places
