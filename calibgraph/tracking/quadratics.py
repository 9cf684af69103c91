"""Matches whose sums alone are kept: a quadratic per camera and place."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.graph.by_place import (
    BlockByPlace,
    QuadraticByPlace,
    SummarizedByPlace,
)
from calibgraph.graph.linear_data import poses_of
from calibgraph.graph.variables import cloud_at_key, matched_at_key
from calibgraph.model.geometry import invert_each, to_T_lidar_camera
from calibgraph.solver.covariance import convex_hessian
from calibgraph.solver.elimination import LatentPoseFit
from calibgraph.solver.within_place import WEAK
from calibgraph.tracking.place_sums import PlaceSums
from calibgraph.tracking.state import State
from calibgraph.tracking.sums import Sums, step_between

Data = BlockByPlace | QuadraticByPlace | SummarizedByPlace
Quadratics = dict[int, dict[str, tuple[gtsam.Pose3, Array]]]
"""Per camera and name of a place: T_lidar_camera at the minimum; (6, 6) information."""


def by_place(
    known: Mapping[str, tuple[gtsam.Pose3, Array]], names: Sequence[str]
) -> QuadraticByPlace:
    """The quadratics of a camera at those of some places where it has one."""
    places = np.array([place for place, name in enumerate(names) if name in known], dtype=np.int64)
    chosen = [known[names[place]] for place in places]
    information = np.array([one for _, one in chosen]).reshape(-1, 6, 6)
    return QuadraticByPlace(places, [pose for pose, _ in chosen], information)


def quadratics_of(
    state: State, sums: PlaceSums, cameras: Iterable[int] | None = None
) -> Quadratics:
    """The quadratics of some cameras, or all, at all places.

    As those of matches that are kept: with the gradient of the robust cost, near the optimum of the
    last epoch, and the Hessian by the weights of the matches there.
    """
    return {
        camera: {
            sums.names[row]: _quadratic(state, sums.rows[row, camera], sums.names[row], camera)
            for row in range(len(sums.names))
            if sums.frames[row, camera]
        }
        for camera in (range(len(state.cameras)) if cameras is None else cameras)
    }


def earlier_quadratics(state: State) -> Quadratics:
    """Those of frames whose matches are not kept."""
    steady = [camera for camera, one in enumerate(state.cameras) if not one.summary.walk]
    return quadratics_of(state, state.places, steady)


def _quadratic(state: State, own: Sums, place: str, camera: int) -> tuple[gtsam.Pose3, Array]:
    reference, information = state.references[camera], own.reweighted + WEAK
    pose = state.pose_at(place, camera)
    if pose is None:
        true = convex_hessian(own.hessian, own.reweighted)
        step = np.linalg.solve(true + WEAK, -own.gradient)
    else:
        step = step_between(reference, pose)
        step = step - np.linalg.solve(information, own.gradient + own.hessian @ step)
    return reference.retract(step), information


def linearized(names: Sequence[str], cameras: Mapping[int, Data], fit: LatentPoseFit) -> Quadratics:
    """The quadratics of all matches at the poses that their places have in a fit."""
    values, count, found = fit.linear.values, len(names), Quadratics()
    clouds = poses_of(values, map(cloud_at_key, range(count)))
    for camera, matches in cameras.items():
        places, T_camera_cloud = matches.places, np.tile(np.eye(4), (count, 1, 1))
        keys = [matched_at_key(int(place), camera) for place in places]
        T_camera_cloud[places] = invert_each(poses_of(values, keys)) @ clouds[places]
        here = matches.sums(T_camera_cloud)
        information = here.hessian + WEAK
        steps = -np.linalg.solve(information, here.gradient[..., None])[..., 0]
        found[camera] = {
            names[place]: (
                to_T_lidar_camera(T_camera_cloud[place]).retract(steps[place]),
                information[place],
            )
            for place in places
        }
    return found
