"""The error model of the batch (``calibgraph.graph.latent_poses``) while frames come in.

Matches that are kept are the batch's factors. Those of earlier frames are a quadratic per camera
and place. The places that no frame of the open epoch is of are one ``HessianFactor``, their
marginal on the cloud and the cameras as matches show them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from calibgraph.arrays import Array
from calibgraph.graph.by_place import (
    BlockByPlace,
    LateQuadraticByPlace,
    QuadraticByPlace,
    SummarizedByPlace,
)
from calibgraph.graph.latent_poses import LatentPoseModel, to_ordering
from calibgraph.graph.linear_data import poses_of
from calibgraph.graph.variables import cloud_at_key, matched_at_key, seen_lens_key
from calibgraph.model.error_components import error_components
from calibgraph.model.geometry import invert_each, pose_rows, to_T_lidar_camera
from calibgraph.solver.curvature import convex_hessian
from calibgraph.solver.data_by_place import block_by_place
from calibgraph.solver.elimination import LatentPoseFit, join_linear
from calibgraph.solver.prior_components import variance_components
from calibgraph.solver.scan_distortion import DistortionEvidence
from calibgraph.solver.within_place import (
    WEAK,
    WithinPlace,
    allow_for_few_frames,
    relative_covariance,
)
from calibgraph.tracking.live_frames import LiveFrame, inliers_of
from calibgraph.tracking.offset_terms import late_quadratic, offset_term, seen_offset_s
from calibgraph.tracking.place_sums import PlaceSums
from calibgraph.tracking.state import State
from calibgraph.tracking.sums import Sums, step_between

Numbers = NDArray[np.int64]
Data = BlockByPlace | QuadraticByPlace | LateQuadraticByPlace | SummarizedByPlace
Quadratics = dict[int, dict[str, tuple[gtsam.Pose3, float, Array]]]
"""Per camera and name of a place: T_lidar_camera and time offset [s] at the minimum; (d, d)
information."""

_PRIOR_FRAMES = 10.0  # weight of the scatter of all frames so far, while a moved camera has few
_WEAK_OFFSET = 0.01  # 1/s^2: of an offset within sight
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
        sums = sums.pose
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

    def within(self, sums: PlaceSums, camera: int, rows: Numbers) -> WithinPlace:
        """As of a batch, of some places."""
        return WithinPlace.of(
            self.covariance[camera],
            float(self.efficiency[camera]),
            roots=np.linalg.cholesky(sums.rows.pose.reweighted[rows, camera] + WEAK),
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
            quadratic = _by_place(state, camera, earlier.get(camera, {}), [*places])
            if isinstance(quadratic, LateQuadraticByPlace):
                cameras[camera] = quadratic
                continue
            own = None if one.summary.walk else inliers_of(kept, camera)
            if own is not None:
                block = block_by_place(own, one.scale, numbers)
                several = len(quadratic.places) > 0
                cameras[camera] = SummarizedByPlace(quadratic, block) if several else block
            elif len(quadratic.places):
                cameras[camera] = quadratic
        return PlaceData([*places], np.array([*places.values()], dtype=np.int64), cameras)


def _by_place(
    state: State,
    camera: int,
    known: Mapping[str, tuple[gtsam.Pose3, float, Array]],
    names: Sequence[str],
) -> QuadraticByPlace | LateQuadraticByPlace:
    """The quadratics of a camera at those of some places where it has one."""
    places = np.array([place for place, name in enumerate(names) if name in known], dtype=np.int64)
    chosen = [known[names[place]] for place in places]
    if state.offsets is not None and chosen:
        return late_quadratic(state, camera, places, chosen)
    information = np.array([one for _, _, one in chosen]).reshape(-1, 6, 6)
    return QuadraticByPlace(places, [pose for pose, _, _ in chosen], information)


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
    blocks, shown, lenses = {}, {}, {}
    for camera, matches in data.cameras.items():
        within = seen.within(sums, camera, chosen)
        if state.offsets is not None:
            rows = np.flatnonzero(sums.frames[:, camera])
            own = seen.within(sums, camera, rows)
            by_place = sums.rows[rows, camera]
            lenses[camera] = offset_term(state, state.offsets, camera, by_place, own)
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
    return LatentPoseModel(names, blocks, (), none, components, state.config.of, lenses)


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
            is_vector = gtsam.symbolChr(key) == gtsam.symbolChr(seen_lens_key(0))
            at.insert(key, values.atVector(key) if is_vector else values.atPose3(key))
        graph.add(gtsam.LinearContainerFactor(factor, at))
    return graph


def quadratics_of(
    state: State,
    sums: PlaceSums,
    cameras: Iterable[int] | None = None,
    *,
    places: Iterable[int] | None = None,
) -> Quadratics:
    """The quadratics of some cameras, or all, at some places, or all.

    As those of matches that are kept: with the gradient of the robust cost, near the optimum of the
    last epoch, and the Hessian by the weights of the matches there.
    """
    return {
        camera: {
            sums.names[row]: _quadratic(state, sums.rows[row, camera], sums.names[row], camera)
            for row in (range(len(sums.names)) if places is None else places)
            if sums.frames[row, camera]
        }
        for camera in (range(len(state.cameras)) if cameras is None else cameras)
    }


def _quadratic(
    state: State, own: Sums, place: str, camera: int
) -> tuple[gtsam.Pose3, float, Array]:
    pose, weak, offset = state.pose_at(place, camera), WEAK, 0.0
    if state.offsets is not None:
        weak = block_diag(WEAK, _WEAK_OFFSET)
        offset = float(state.offsets.values_s[camera])
    information = own.reweighted + weak
    if pose is None:
        step = np.linalg.solve(convex_hessian(own.hessian, own.reweighted) + weak, -own.gradient)
    else:
        step = step_between(state.references[camera], pose)
        if state.offsets is not None and state.optimum is not None:
            step = np.append(step, seen_offset_s(state, state.optimum, camera) - offset)
        step = step - np.linalg.solve(information, own.gradient + own.hessian @ step)
    found = state.references[camera].retract(step[:6])
    return found, offset + float(step[6:].sum()), information


def linearized(data: PlaceData, fit: LatentPoseFit) -> Quadratics:
    """The quadratics of all matches at the poses that their places have in a fit."""
    values, count, found = fit.linear.values, len(data.names), Quadratics()
    clouds = poses_of(values, map(cloud_at_key, range(count)))
    for camera, matches in data.cameras.items():
        assert not isinstance(matches, LateQuadraticByPlace)  # it is no nearer there
        places, T_camera_cloud = matches.places, np.tile(np.eye(4), (count, 1, 1))
        keys = [matched_at_key(int(place), camera) for place in places]
        T_camera_cloud[places] = invert_each(poses_of(values, keys)) @ clouds[places]
        here = matches.sums(T_camera_cloud)
        information = here.hessian + WEAK
        steps = -np.linalg.solve(information, here.gradient[..., None])[..., 0]
        found[camera] = {
            data.names[place]: (
                to_T_lidar_camera(T_camera_cloud[place]).retract(steps[place]),
                0.0,
                information[place],
            )
            for place in places
        }
    return found


def _distortion(state: State, camera: int, places: int) -> DistortionEvidence | None:
    """The quadratics of all epochs, as if of the first place; None if there are none."""
    if not any(state.findings.bend_sigmas):
        return None
    own = state.all_distortion[camera]
    found = DistortionEvidence.none(WEAK, places=places)
    if state.config.preset == "auto":
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
