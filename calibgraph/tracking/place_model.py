"""The error model of the batch (``calibgraph.graph.latent_poses``) while frames come in.

Matches that are kept are the batch's factors. Those of earlier frames are a quadratic per camera
and place. The places that no frame of the open epoch is of are one ``HessianFactor``, their
marginal on the cloud and the cameras as matches show them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.graph.by_place import (
    SummarizedByPlace,
)
from calibgraph.graph.latent_poses import LatentPoseModel, to_ordering
from calibgraph.graph.variables import cloud_at_key, matched_at_key
from calibgraph.model.findings import error_components
from calibgraph.model.geometry import pose_rows
from calibgraph.solver.columns import DistortionEvidence
from calibgraph.solver.curvature import convex_hessian
from calibgraph.solver.elimination import LatentPoseFit, join_linear
from calibgraph.solver.variance_components import variance_components
from calibgraph.solver.within_place import (
    WEAK,
    WithinPlace,
    allow_for_few_frames,
    block_by_place,
    relative_covariance,
    split_excess,
)
from calibgraph.tracking.live_frames import LiveFrame, inliers_of
from calibgraph.tracking.place_sums import PlaceSums
from calibgraph.tracking.quadratics import Data, Quadratics, by_place
from calibgraph.tracking.state import State

Numbers = NDArray[np.int64]
_PRIOR_FRAMES = 10.0  # weight of the scatter of all frames so far, while a moved camera has few
_EXACT = 1e-4  # rad and m: what is stated of places to be smaller counts as nothing


@dataclass(frozen=True, eq=False)
class FrameSpread:
    """What the frames of each camera show of their errors.

    Attributes:
        covariance: (n, 6, 6) K of ``calibgraph.solver.within_place``.
        efficiency: (n,) of independent matches: their true variance over that of H, in the mean.
    """

    covariance: Array
    efficiency: Array

    @staticmethod
    def of(state: State, sums: PlaceSums) -> FrameSpread:
        """Of each camera's frames about the means of their places.

        With an allowance for few frames, as in a batch. While a camera that has moved has few
        frames, the scatter is shrunk towards that of all its frames so far. Where the matcher
        states nothing of places it is wider if epochs scatter more than their frames suggest.
        """
        (scatter, left), every = sums.within_places, sums.rows.total()
        hessian, reweighted, frames = every.hessian, every.reweighted, every.frames
        found = FrameSpread(np.tile(np.eye(6), (len(frames), 1, 1)), np.ones(len(frames)))
        for camera in map(int, np.flatnonzero(frames)):
            own = _usual_while_few(state, camera, scatter[camera], frames[camera])
            if not states_places(state):
                own = state.widen(camera, own)
            true = convex_hessian(hessian[camera], reweighted[camera]) + WEAK
            own = allow_for_few_frames(
                own, true, left[camera], frames=frames[camera], matches=every.matches[camera]
            )
            root = np.linalg.cholesky(reweighted[camera] + WEAK)
            of_camera = relative_covariance(own, root, true)
            found.covariance[camera], found.efficiency[camera] = of_camera
        return found

    @cached_property
    def _excesses(self) -> list[tuple[float, Array]]:
        return [*map(split_excess, self.covariance)]

    def least(self, camera: int) -> float:
        """Variance of a camera's matches, of what they do not share, over that of H."""
        return self._excesses[camera][0]

    def within(self, sums: PlaceSums, camera: int, rows: Numbers) -> WithinPlace:
        """As of a batch, of some places."""
        return WithinPlace(
            *self._excesses[camera],
            float(self.efficiency[camera]),
            roots=np.linalg.cholesky(sums.rows.reweighted[rows, camera] + WEAK),
            frames=sums.frames[rows, camera] / sums.places[rows, camera],
            alike=float(sums.alike[camera]),
        )


@dataclass(frozen=True, eq=False)
class PlaceData:
    """The matches of some places, as if all were independent.

    Attributes:
        names: of the places.
        rows: (p,) theirs, in the sums over all frames.
        cameras: per camera (by its place in the rig) that has some.
    """

    names: Sequence[str]
    rows: Numbers
    cameras: Mapping[int, Data]

    @staticmethod
    def of(
        state: State, earlier: Quadratics, frames: Sequence[LiveFrame], places: Mapping[str, int]
    ) -> PlaceData:
        """Of frames whose matches are kept, and the quadratics of earlier ones.

        Args:
            state: of the tracker.
            earlier: these; of a camera that drifts, of all frames.
            frames: the others.
            places: the rows by their names.
        """
        numbers = [
            np.array([frame.number for frame in frames if frame.place == name], dtype=np.int64)
            for name in places
        ]
        kept, cameras = [frame for frame in frames if frame.place in places], dict[int, Data]()
        for camera, one in enumerate(state.cameras):
            quadratic = by_place(earlier.get(camera, {}), [*places])
            own = None if one.summary.walk else inliers_of(kept, camera)
            if own is not None:
                block = block_by_place(own, one.scale, numbers)
                several = len(quadratic.places) > 0
                cameras[camera] = SummarizedByPlace(quadratic, block) if several else block
            elif len(quadratic.places):
                cameras[camera] = quadratic
        return PlaceData([*places], np.array([*places.values()], dtype=np.int64), cameras)


def place_model(
    state: State, sums: PlaceSums, seen: FrameSpread, data: PlaceData
) -> LatentPoseModel:
    """The graph of some places, without any prior of a camera.

    Args:
        state: of the tracker.
        sums: of all frames.
        seen: by the frames of each camera.
        data: the matches of the places.
    """
    chosen, names = data.rows, state.names
    blocks, shown = {}, {}
    for camera, matches in data.cameras.items():
        within = seen.within(sums, camera, chosen)
        blocks[names[camera]] = matches.with_variance(within.least)
        shown[names[camera]] = within, _distortion(state, camera, len(chosen))
    components = variance_components(state.findings, names, shown, places=len(chosen))
    alike = np.where(sums.frames[chosen] > 0, sums.places[chosen], np.inf).min(axis=1)
    clouds = components.cloud_at_place / alike[:, None, None]
    prior = error_components()
    robust = _count(sums) >= prior.robust_places
    components = replace(
        components,
        cloud_at_place=clouds,
        robust_scale=prior.robust_sigmas if robust else np.inf,
    )
    components = state.sizes.scale(components)
    none = gtsam.NonlinearFactorGraph()
    return LatentPoseModel(names, blocks, (), none, components, state.config.of)


def marginals_of_places(fit: LatentPoseFit) -> list[gtsam.GaussianFactorGraph]:
    """Per place its marginal on the cloud and the cameras as matches show them everywhere."""
    model, placed = fit.linear.model, fit.linear.placed
    keys = [[cloud_at_key(place)] for place in range(model.places)]
    for place, camera in model.matched_places:
        keys[place].insert(0, matched_at_key(place, camera))
    place_of_key = {key: place for place, own in enumerate(keys) for key in own}
    graphs = [gtsam.GaussianFactorGraph() for _ in keys]
    for index in range(placed.size()):
        factor = placed.at(index)
        place = next(place_of_key[key] for key in list(factor.keys()) if key in place_of_key)
        graphs[place].push_back(factor)
    return [
        graph.eliminatePartialSequential(to_ordering(own))[1]
        for graph, own in zip(graphs, keys, strict=True)
    ]


def summary_factor(
    marginals: Sequence[gtsam.GaussianFactorGraph], fit: LatentPoseFit, kept: Sequence[int]
) -> gtsam.NonlinearFactorGraph:
    """One factor that stands for some places of a fit: their marginals, linearized there."""
    graph, values = gtsam.NonlinearFactorGraph(), fit.linear.values
    if kept:
        joined = join_linear(*(marginals[place] for place in kept))
        factor, at = gtsam.HessianFactor(joined), gtsam.Values()
        for key in list(factor.keys()):
            at.insert(key, values.atPose3(key))
        graph.add(gtsam.LinearContainerFactor(factor, at))
    return graph


def _distortion(state: State, camera: int, places: int) -> DistortionEvidence | None:
    """The quadratics of all epochs, as if of the first place; None if there are none."""
    if not any(state.findings.bend_sigmas):
        return None
    own = state.all_distortion[camera]
    found = DistortionEvidence.none(WEAK, places=places)
    found.information[0], found.vector[0] = own.information[0], own.vector[0]
    return replace(found, jacobian=own.jacobian, hessian=own.hessian)


def states_places(state: State) -> bool:
    """Whether frames of one place share more than all frames do."""
    stated = state.findings
    sizes = stated.place_rotation_rad, stated.place_translation_m
    return stated.place_variance > 0 or max(sizes) > _EXACT


def _count(sums: PlaceSums) -> float:
    """Number of places."""
    older = sums.places[0].max() if sums.frames[0].any() else 0.0
    return float(np.count_nonzero(sums.frames[1:].any(axis=1)) + older)


def _usual_while_few(state: State, camera: int, scatter: Array, frames: float) -> Array:
    """(6, 6) scatter of a camera's frames, that of all before counted in after a move."""
    one = state.cameras[camera]
    if one.moved_at < 0 or one.summary.walk:
        return scatter
    share, rows = _PRIOR_FRAMES / (frames + _PRIOR_FRAMES), pose_rows(camera)
    usual = state.total[rows, rows] * (frames / max(state.total_frames[camera], 1.0))
    return np.asarray((1.0 - share) * scatter + share * usual)
