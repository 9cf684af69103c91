"""Relative poses of the rig that contradict the correspondences of both their cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.graph.latent_poses import LatentPoseModel
from calibgraph.graph.objective import join, objective_graph
from calibgraph.graph.variables import camera_key
from calibgraph.model.findings import error_components
from calibgraph.model.geometry import to_T_camera_lidar
from calibgraph.model.rig import RelativePose
from calibgraph.solver.conflicts import Conflict, relative_pose_conflict
from calibgraph.solver.covariance import ENOUGH_FRAMES
from calibgraph.solver.elimination import LatentPoseFit, Linearization, fit_latent_poses
from calibgraph.solver.error_model import held_graph
from calibgraph.tracking.place_sums import PlaceSums
from calibgraph.tracking.state import State
from calibgraph.tracking.sums import is_determined

Conflicts = dict[int, Conflict]
Rows = tuple[int, ...]


def fit_without_contradictions(
    state: State, sums: PlaceSums, model: LatentPoseModel, values: gtsam.Values
) -> tuple[LatentPoseFit, Rows]:
    """The optimum with priors and relative poses, and which of these contradict the data.

    Args:
        state: of the tracker.
        sums: of the frames of the model.
        model: without any prior of a camera.
        values: near the optimum.
    """
    dropped = contradicting(find_conflicts(state, sums, model, values))
    model = replace(model, pose_graph=pose_priors(state, dropped))
    was_determined = state.optimum is not None and not state.rig.relative_poses
    fit = fit_latent_poses(model, values, is_determined=was_determined)
    if fit is None:
        raise RuntimeError("a direction of a camera is not determined")
    return fit, dropped


def contradicting(conflicts: Conflicts) -> Rows:
    """Those that take no part, by their places in the rig."""
    limit = error_components().contradiction_sigmas
    return tuple(place for place, one in conflicts.items() if one.largest > limit)


def pairs_without(state: State, dropped: Rows = ()) -> tuple[RelativePose, ...]:
    """The relative poses that no move has invalidated, but for some, by their places in the rig."""
    pairs = enumerate(state.rig.relative_poses)
    return tuple(pair for place, pair in pairs if place not in (*state.dropped_pairs, *dropped))


def pose_priors(state: State, dropped: Rows = ()) -> gtsam.NonlinearFactorGraph:
    """Priors about the references, and the relative poses that no move has invalidated.

    Args:
        state: of the tracker.
        dropped: further relative poses that take no part.
    """
    rig, pairs = state.rig, pairs_without(state, dropped)
    if len(pairs) < len(rig.relative_poses):
        rig = rig.model_copy(update={"relative_poses": pairs})
    return objective_graph(rig, {}, poses_by_name(state), state.config, terms="full")


def find_conflicts(
    state: State, sums: PlaceSums, model: LatentPoseModel, values: gtsam.Values
) -> Conflicts:
    """Conflicts between the rig's relative poses and the correspondences, by place in the rig."""
    if not state.rig.relative_poses:
        return {}
    every = sums.rows.total()
    known = [
        camera
        for camera, one in enumerate(state.cameras)
        if one.started
        and every.frames[camera] >= ENOUGH_FRAMES
        and is_determined(every.hessian[camera])
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
    held = held_graph(state.names, poses_by_name(state), others)
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


def _rows(cameras: Sequence[int]) -> NDArray[np.intp]:
    return np.add.outer(6 * np.asarray(cameras, dtype=np.intp), np.arange(6)).ravel()


def poses_by_name(state: State) -> dict[str, Array]:
    """Per camera its (4, 4) reference."""
    poses = zip(state.names, state.references, strict=True)
    return {name: to_T_camera_lidar(pose) for name, pose in poses}
