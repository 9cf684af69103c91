"""The error model of the batch (``calibgraph.graph.latent_poses``) on sums over places.

A camera's matches at a place are one quadratic. The places that no frame of the open epoch is of
are one ``HessianFactor``, their marginal on the cloud and the cameras as matches show them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.graph.by_place import QuadraticByPlace
from calibgraph.graph.latent_poses import LatentPoseModel, to_ordering
from calibgraph.graph.variables import cloud_at_key, matched_at_key
from calibgraph.model.error_components import error_components
from calibgraph.model.geometry import pose_rows
from calibgraph.solver.covariance import with_pseudo_frames
from calibgraph.solver.curvature import convex_hessian
from calibgraph.solver.elimination import LatentPoseFit, join_linear
from calibgraph.solver.prior_components import variance_components
from calibgraph.solver.scan_distortion import DistortionEvidence
from calibgraph.solver.within_place import WEAK, WithinPlace
from calibgraph.tracking.place_sums import PlaceSums
from calibgraph.tracking.state import State

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

_PRIOR_FRAMES = 10.0  # weight of the scatter of all frames so far, while a moved camera has few
_EXACT = 1e-4  # rad and m: what is stated of places to be smaller counts as nothing


@dataclass(frozen=True, eq=False)
class FrameSpread:
    """What the frames of each camera show of their errors.

    Attributes:
        root: (n, 6, 6) R: with L L^T the reweighted Hessian, the true one is L R R^T L^T; the sums
            over a place are too few for a true Hessian of its own.
        covariance: (n, 6, 6) K of ``calibgraph.solver.within_place``.
    """

    root: Array
    covariance: Array

    @staticmethod
    def of(state: State, sums: PlaceSums) -> FrameSpread:
        """Of each camera's frames about the means of their places.

        With an allowance for few frames, as in a batch. While a camera that has moved has few
        frames, the scatter is shrunk towards that of all its frames so far. Where the matcher
        states nothing of places it is wider if epochs scatter more than their frames suggest.
        """
        scatter, frames, left = sums.of_all
        hessian, reweighted = sums.hessian.sum(axis=0), sums.reweighted.sum(axis=0)
        matches = sums.matches.sum(axis=0)
        found = FrameSpread(*np.tile(np.eye(6), (2, len(frames), 1, 1)))
        correlation = error_components().frame_correlation
        for camera in np.flatnonzero(frames):
            count, seen = frames[camera], left[camera] + 1.0
            own = _usual_while_few(state, int(camera), scatter[camera], count)
            if not _states_places(state):
                own = state.widen(int(camera), own)
            true = convex_hessian(hessian[camera], reweighted[camera])
            usual = 1.0 + correlation * (matches[camera] / count - 1.0)
            usual = usual * true * seen / count
            whole = with_pseudo_frames(own, true, np.full(6, seen), usual) * count / seen
            outer = np.linalg.cholesky(reweighted[camera] + WEAK)
            inverse = np.linalg.inv(true + WEAK)
            found.root[camera] = np.linalg.cholesky(_whiten(outer, true + WEAK))
            found.covariance[camera] = outer.T @ inverse @ whole @ inverse @ outer
        return found

    def within(self, sums: PlaceSums, camera: int, rows: Numbers) -> WithinPlace:
        """As of a batch, of some places."""
        inverse = np.linalg.inv(self.root[camera])
        return WithinPlace.of(
            self.covariance[camera],
            float(np.square(inverse).sum()) / 6,
            roots=np.linalg.cholesky(sums.reweighted[rows, camera] + WEAK),
            frames=sums.frames[rows, camera] / sums.places[rows, camera],
            alike=float(sums.alike[camera]),
        )


def place_model(
    state: State, sums: PlaceSums, seen: FrameSpread, rows: Sequence[int]
) -> LatentPoseModel:
    """The graph of some places, without any prior of a camera.

    Args:
        state: of the tracker.
        sums: of all frames.
        seen: by the frames of each camera.
        rows: of ``sums``, the places.
    """
    chosen, names = np.asarray(rows, dtype=np.int64), state.names
    blocks, shown = {}, {}
    for camera in np.flatnonzero(sums.frames.any(axis=0)):
        name, within = names[camera], seen.within(sums, int(camera), chosen)
        quadratic = _quadratic(state, sums, seen.root[camera], int(camera), rows=chosen)
        information = quadratic.information / within.least
        blocks[name] = replace(quadratic, information=information)
        shown[name] = within, _distortion(state, int(camera), len(chosen))
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
    for place, camera in model.matched_places():
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
    marginals: Sequence[gtsam.GaussianFactorGraph], values: gtsam.Values
) -> gtsam.NonlinearFactorGraph:
    """One factor that stands for places: their marginals, linearized at ``values``."""
    graph = gtsam.NonlinearFactorGraph()
    if marginals:
        factor, at = gtsam.HessianFactor(join_linear(*marginals)), gtsam.Values()
        for key in list(factor.keys()):
            at.insert(key, values.atPose3(key))
        graph.add(gtsam.LinearContainerFactor(factor, at))
    return graph


def _quadratic(
    state: State, sums: PlaceSums, root: Array, camera: int, *, rows: Numbers
) -> QuadraticByPlace:
    """The matches of a camera, as if all were independent."""
    present = np.flatnonzero(sums.frames[rows, camera])
    reweighted = sums.reweighted[rows[present], camera] + WEAK
    outer = np.linalg.cholesky(reweighted) @ root
    pull = -sums.gradient[rows[present], camera][..., None]
    steps = np.linalg.solve(outer.swapaxes(1, 2), np.linalg.solve(outer, pull))[..., 0]
    poses = [state.references[camera].retract(step) for step in steps]
    return QuadraticByPlace(present, poses, reweighted)


def _distortion(state: State, camera: int, places: int) -> DistortionEvidence | None:
    """The quadratics of all epochs, as if of the first place; None if there are none."""
    if not any(state.findings.bend_sigmas):
        return None
    sums = state.all_bends
    information, vector = np.zeros((places, 3, 3)), np.zeros((places, 3))
    if state.config.preset == "auto":
        information[0], vector[0] = sums.information[camera], sums.vector[camera]
    return DistortionEvidence(sums.shifts[camera], sums.hessian[camera], information, vector)


def _states_places(state: State) -> bool:
    """Whether frames of one place share more than all frames do."""
    stated = state.findings
    sizes = stated.place_rotation_rad, stated.place_translation_m
    return stated.place_variance > 0 or max(sizes) > _EXACT


def _count(sums: PlaceSums) -> float:
    """Number of places."""
    older = sums.places[0].max() if sums.frames[0].any() else 0.0
    return float(np.count_nonzero(sums.frames[1:].any(axis=1)) + older)


def _whiten(root: Array, matrix: Array) -> Array:
    """(6, 6) R^-1 M R^-T of a symmetric M."""
    found = np.linalg.solve(root, np.linalg.solve(root, matrix).T)
    return np.asarray((found + found.T) / 2)


def _usual_while_few(state: State, camera: int, scatter: Array, frames: float) -> Array:
    """(6, 6) scatter of a camera's frames, that of all before counted in after a move."""
    one = state.cameras[camera]
    if one.moved_at < 0 or one.summary.walk:
        return scatter
    share, rows = _PRIOR_FRAMES / (frames + _PRIOR_FRAMES), pose_rows(camera)
    usual = state.total[rows, rows] * (frames / max(state.total_frames[camera], 1.0))
    return np.asarray((1.0 - share) * scatter + share * usual)
