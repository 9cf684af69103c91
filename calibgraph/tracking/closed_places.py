"""The closed epochs, and with the open one optimum and marginal of the error model's graph.

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
from calibgraph.model.findings import MatcherFindings
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
    Quadratics,
    linearized,
    marginals_of_places,
    place_model,
    quadratics_of,
    summary_factor,
)
from calibgraph.tracking.place_sums import PlaceSums, sums_by_place
from calibgraph.tracking.posterior import closed_posterior, split_halves
from calibgraph.tracking.state import State
from calibgraph.tracking.sums import Sums
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
        posterior: (n,) over summaries and frames.
        halves: (n, 2) over every other epoch.
        findings: with which the rest was made.
        seen: by the frames of each camera.
        data: of the places of the graph.
        fit: the graph near its optimum.
        quadratics: of its matches there.
        contradicting: places in ``rig.relative_poses`` of those that take no part.
        pose_graphs: the priors, without some relative poses.
        sizes: the variance ratios of the graph.
    """

    sums: PlaceSums
    posterior: Sums
    halves: Sums
    findings: MatcherFindings
    seen: FrameSpread
    data: PlaceData
    fit: LatentPoseFit
    quadratics: Quadratics
    contradicting: Rows
    pose_graphs: dict[Rows, gtsam.NonlinearFactorGraph]
    sizes: VarianceRatios
    _summaries: dict[Rows, gtsam.NonlinearFactorGraph] = field(default_factory=dict)

    @staticmethod
    def of(state: State) -> ClosedPlaces:
        """Of a state's closed epochs, at the optimum that the state has, or else fitted."""
        frames = [frame for epoch in state.epochs[:-1] for frame in epoch.frames]
        sums, earlier = state.places.add(sums_by_place(frames)), state.places
        for camera in state.drifting:
            sums, earlier = sums.without(camera), earlier.without(camera)
        seen = FrameSpread.of(state, sums)
        rows = {sums.names[row]: int(row) for row in np.flatnonzero(sums.frames.any(axis=1))}
        data = PlaceData.of(state, quadratics_of(state, earlier), frames, rows)
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
        return ClosedPlaces(
            sums, closed_posterior(state), split_halves(state), state.findings, seen, data,
            fit, linearized(data, fit), dropped, pose_graphs, state.sizes,
        )  # fmt: skip

    def fitted(self, state: State) -> ClosedPlaces:
        """At the optimum for the variance ratios of the state."""
        model = place_model(state, self.sums, self.seen, self.data)
        fit, dropped, _ = fit_without_contradictions(
            state, self.sums, model, self.fit.linear.values, pose_graphs=self.pose_graphs
        )
        return replace(
            self,
            fit=fit,
            quadratics=linearized(self.data, fit),
            contradicting=dropped,
            sizes=state.sizes,
            _summaries={},
        )

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

    def fit_with(self, state: State, sums: Sums) -> tuple[LatentPoseFit, Conflicts, Sequence[str]]:
        """The optimum with the frames of the open epoch, and the relative poses that contradict.

        Further the names of its places.

        Args:
            state: of the tracker.
            sums: over its summaries and live frames.
        """
        frames = state.epochs[-1].frames
        every = self.sums.add(sums_by_place(frames))
        for camera in state.drifting:  # its sums are as if of the present place
            every = every.with_camera_at(state.live_frames[-1].place, camera, sums[camera])
        earlier = self.quadratics | quadratics_of(state, every, state.drifting)
        seen = self.seen if self.is_settled(state) else FrameSpread.of(state, every)
        if state.config.preset == "auto":
            kept, rows = self._split(every, {f.place for f in (*frames, *state.live_frames[-1:])})
        else:  # the weights of a preset of the paper
            every = every.bounded(most=0)
            earlier = quadratics_of(state, every)
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
        return fit, conflicts, data.names

    def _split(self, every: PlaceSums, touched: set[str]) -> tuple[Rows, list[int]]:
        """Which of the closed places a summary stands for, and the rows of the other places.

        These have the last place of every camera that was at none of those that are touched: a
        graph has the variables of the cameras that have matches in it.
        """
        seen, names = every.frames > 0, every.names
        rows = {row for row in np.flatnonzero(seen.any(axis=1)).tolist() if names[row] in touched}
        for camera in np.flatnonzero(seen.any(axis=0)):
            own = np.flatnonzero(seen[:, camera]).tolist()
            rows |= set() if rows.intersection(own) else {own[-1]}
        others = {names[row] for row in rows}
        kept = tuple(i for i, name in enumerate(self.data.names) if name not in others)
        return kept, sorted(rows)


def settle(state: State) -> tuple[State, ClosedPlaces]:
    """The state with optimum and variance ratios of its closed epochs, while these are few.

    Later an epoch changes little, and the frames after it do the work step by step.
    """
    closed = ClosedPlaces.of(state)
    if closed.is_settled(state):
        return state, closed
    for step in range(1, STEPS + 1):
        state, closed = refine(state, closed, step)
    return state, ClosedPlaces.of(state)


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
