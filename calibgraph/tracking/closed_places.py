"""The closed epochs, and with the open one the error model's graph (``tracking.window``).

Between the ends of epochs the places that no frame of the open epoch is of keep the weights that
their robust loss has at the optimum of the last one: within 0.02 sigma that is the whole graph.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import gtsam
import numpy as np

from calibgraph.graph.latent_poses import LatentPoseModel
from calibgraph.graph.objective import join
from calibgraph.solver.components import estimate_variance_ratios
from calibgraph.solver.elimination import LatentPoseFit, Linearization, start_values
from calibgraph.tracking.contradictions import (
    Conflicts,
    Rows,
    contradicting,
    find_conflicts,
    fit_without_contradictions,
    pose_priors,
    poses_by_name,
)
from calibgraph.tracking.epoch_sums import sum_closed_epochs
from calibgraph.tracking.frozen import changed
from calibgraph.tracking.optimum import Optimum
from calibgraph.tracking.place_model import (
    FrameSpread,
    PlaceData,
    marginals_of_places,
    place_model,
    summary_factor,
)
from calibgraph.tracking.place_sums import PlaceSums, sums_by_place
from calibgraph.tracking.quadratics import (
    Quadratics,
    earlier_quadratics,
    linearized,
    quadratics_of,
)
from calibgraph.tracking.state import State
from calibgraph.tracking.sums import Sums, equation_5
from calibgraph.tracking.window import Window

_SETTLED = 50.0  # frames of a camera: an epoch more hardly changes their scatter
_ROUNDS = 2  # of estimates of the variance ratios, a fit after each


@dataclass(frozen=True, eq=False)
class ClosedPlaces:
    """The frames of closed epochs, and the graph of their places.

    Attributes:
        state: of the tracker, with the findings and variance ratios of the graph.
        sums: per place; of a camera that drifts, none.
        seen: by the frames of each camera.
        data: of the places of the graph.
        fit: the graph near its optimum.
        contradicting: places in ``rig.relative_poses`` of those that take no part.
    """

    state: State
    sums: PlaceSums
    seen: FrameSpread
    data: PlaceData
    fit: LatentPoseFit
    contradicting: Rows
    _pose_graphs: dict[tuple[Rows, Rows | None], gtsam.NonlinearFactorGraph] = field(
        default_factory=dict
    )

    @staticmethod
    def of(state: State, *, fitted: bool = False) -> ClosedPlaces:
        """Of a state's closed epochs, at the optimum that the state has, or else fitted."""
        frames = [frame for epoch in state.epochs[:-1] for frame in epoch.frames]
        sums = state.places.add(sums_by_place(frames))
        for camera in state.drifting:
            sums = sums.without(camera)
        rows = {sums.names[row]: int(row) for row in np.flatnonzero(sums.frames.any(axis=1))}
        seen = FrameSpread.of(state, sums)
        data = PlaceData.of(state, earlier_quadratics(state), frames, rows)
        model = place_model(state, sums, seen, data)
        values = _start(state, model, data.names)
        if state.optimum is None or fitted:
            fit, dropped = fit_without_contradictions(state, sums, model, values)
        else:
            dropped = state.optimum.contradicting
            model = changed(model, pose_graph=pose_priors(state, dropped))
            fit = LatentPoseFit(Linearization.at(model, values), 0, True)
        return ClosedPlaces(state, sums, seen, data, fit, dropped)

    def fitted(self, state: State) -> ClosedPlaces:
        """At the optimum for the variance ratios of the state."""
        model = place_model(state, self.sums, self.seen, self.data)
        fit, dropped = fit_without_contradictions(state, self.sums, model, self.fit.linear.values)
        return ClosedPlaces(state, self.sums, self.seen, self.data, fit, dropped)

    @property
    def optimum(self) -> Optimum:
        """The poses there."""
        linear = self.fit.linear
        return Optimum.of(linear.model, linear.values, self.data.names, self.contradicting)

    @cached_property
    def quadratics(self) -> Quadratics:
        """The matches of the graph near its optimum."""
        return linearized(self.data.names, self.data.cameras, self.fit)

    @cached_property
    def marginals(self) -> list[gtsam.GaussianFactorGraph]:
        """Per place, on what all places share."""
        return marginals_of_places(self.fit)

    @cached_property
    def _closed_sums(self) -> Sums:
        return sum_closed_epochs(self.state)

    def _priors(self, dropped: Rows = ()) -> gtsam.NonlinearFactorGraph:
        """Priors and relative poses without some; those of the fit if it dropped the same."""
        same = dropped == self.contradicting
        return self.fit.linear.model.pose_graph if same else pose_priors(self.state, dropped)

    def all_sums(self, state: State) -> Sums:
        """(n,) over the summaries and all live frames."""
        return self._closed_sums + state.epochs[-1].sums

    def equation_5(
        self, state: State, more: Mapping[int, Sums] | None = None
    ) -> gtsam.NonlinearFactorGraph:
        """Eq. 5 of the paper with the sums of all frames, and more of some cameras."""
        sums = self.all_sums(state)
        for camera, own in (more or {}).items():
            sums = sums.replace_at(camera, sums[camera] + own)
        return equation_5(self._priors(), state.references, sums)

    @property
    def shows_ratios(self) -> bool:
        """Whether anything is measured twice."""
        return not self.sums.is_of_one_place or bool(self.state.rig.relative_poses)

    @property
    def is_settled(self) -> bool:
        """Whether an epoch's frames more would hardly change the scatter of frames."""
        cameras = zip(self.state.cameras, self.sums.frames.sum(axis=0), strict=True)
        return all(count >= _SETTLED for one, count in cameras if one.started)

    def with_open_epoch(self, state: State, window: Window | None) -> tuple[Window, Conflicts]:
        """The whole graph in iSAM2, and the conflicts of relative poses with correspondences.

        The window of the frame before, if it is of the same epoch, goes on if its graph allows.
        """
        frames = state.epochs[-1].frames
        opened = (*frames, *state.live_frames[-1:])
        touched = {frame.place for frame in opened}
        every = self.sums.add(sums_by_place(frames))
        for camera in state.drifting:  # its sums are as if of the present place
            own = self.all_sums(state)[camera]
            every = every.with_camera_at(state.live_frames[-1].place, camera, own)
        earlier = self.quadratics | quadratics_of(state, every, state.drifting)
        seen = self.seen if self.is_settled else FrameSpread.of(state, every)
        kept, rows = self._split(every, touched)
        data = PlaceData.of(state, earlier, frames, {every.names[row]: row for row in rows})
        model = place_model(state, every, seen, data)
        conflicts = Conflicts()
        if state.rig.relative_poses:
            start = _start(state, model, data.names)
            before = changed(model, pose_graph=self._summary(kept))
            conflicts = find_conflicts(state, every, before, start)
        model = changed(model, pose_graph=self._pose_graph(kept, contradicting(conflicts)))
        if window is not None and window.has_graph_of(model, data.names):
            window.exchange(model)
        else:
            window = Window(model, data.names, _start(state, model, data.names))
        return window, conflicts

    def _summary(self, kept: Rows) -> gtsam.NonlinearFactorGraph:
        """One factor that stands for some of the places."""
        if (kept, None) not in self._pose_graphs:
            marginals = self.marginals if kept else ()
            self._pose_graphs[kept, None] = summary_factor(marginals, self.fit, kept)
        return self._pose_graphs[kept, None]

    def _pose_graph(self, kept: Rows, dropped: Rows) -> gtsam.NonlinearFactorGraph:
        """The same with the priors, without some relative poses."""
        if (kept, dropped) not in self._pose_graphs:
            self._pose_graphs[kept, dropped] = join(self._priors(dropped), self._summary(kept))
        return self._pose_graphs[kept, dropped]

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


def settle(state: State) -> State:
    """The state with optimum and variance ratios of its closed epochs."""
    closed = ClosedPlaces.of(state, fitted=True)
    for _ in range(_ROUNDS if closed.shows_ratios else 0):
        found = estimate_variance_ratios(closed.fit, state.sizes)
        if found.is_near(state.sizes):
            break
        state = changed(state, sizes=found)
        closed = closed.fitted(state)
    return changed(state, optimum=closed.optimum)


def _start(state: State, model: LatentPoseModel, names: Sequence[str]) -> gtsam.Values:
    """Values near the optimum of a model, of places of these names."""
    guess = poses_by_name(state)
    if state.optimum is None:
        return start_values(model, guess)
    return state.optimum.values(model, names, guess)
