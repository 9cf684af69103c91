"""What a change of place looks like: a step of all cameras that is no move.

Frames of one place share errors. So sums over frames before and after some time differ by more than
their scatter, unless they are of the same places; and so does a single frame from those before it.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.error_components import error_components
from calibgraph.model.geometry import adjoint_camera_lidar, pose_rows, to_T_camera_lidar
from calibgraph.solver.prior_components import pose_covariance
from calibgraph.solver.within_place import WEAK
from calibgraph.tracking.cause import chance_limit, squared_sigmas
from calibgraph.tracking.live_frames import LiveFrame, OutlierFrame
from calibgraph.tracking.outlier_frames import agrees
from calibgraph.tracking.place_sums import PlaceSums, sums_by_place
from calibgraph.tracking.posterior import posterior, steps_of, true_hessian
from calibgraph.tracking.state import LEAST_FRAMES, State
from calibgraph.tracking.sums import is_determined, step_between

Array = NDArray[np.float64]


def shift_since(state: State, number: int) -> Array:
    """(6 n, 6 n) covariance of the steps between frames before a number and those from it on."""
    live = state.live_frames
    before = [frame for frame in live if frame.number < number]
    after = [frame for frame in live if frame.number >= number]
    return shift_between(state, before, after)


def shift_between(state: State, before: Iterable[LiveFrame], after: Iterable[LiveFrame]) -> Array:
    """(6 n, 6 n) covariance of the steps between sets of frames, by what places share.

    Args:
        state: with the older frames, which are added to the first set.
        before: live frames of the first set.
        after: of the second.
    """
    n = len(state.cameras)
    return _shift(state, _counts(before, n), _counts(after, n))


def agrees_at_its_place(state: State, camera: int, own: OutlierFrame) -> bool:
    """Whether a frame that disagrees with a camera's estimate agrees with the pose of its place.

    Before, that pose differs from the estimate by what places share; then by what earlier frames
    there show, if any, and by this frame's own pose, each with the noise of its frames.

    Args:
        state: before the frame is absorbed; the last live frame has its place.
        camera: by its place in the rig.
        own: the frame, with the T_lidar_camera that fits it.
    """
    before = _displacement(state, camera)
    hessian, reference = _frame_hessian(state, camera, own), state.references[camera]
    if before is None or not is_determined(hessian):
        return False
    places = state.places.add(sums_by_place(state.live_frames))
    noise = _frame_noise(places, camera, own, hessian)
    step, covariance = steps_of(state)[camera], before
    there = places.names.index(state.live_frames[-1].place), camera
    at_place = places.rows[there]
    if is_determined(at_place.hessian):
        shown = np.linalg.solve(at_place.hessian, -at_place.gradient) - step
        of_frames = _sandwich(at_place.hessian, at_place.frames * noise)
        gain = _gain(covariance, of_frames)
        step, covariance = step + gain @ shown, covariance - gain @ covariance
    shown, noise = step_between(reference, own.T_lidar_camera) - step, _sandwich(hessian, noise)
    if squared_sigmas(shown, covariance + noise) > chance_limit():
        return False
    of_place = reference.retract(step + _gain(covariance, noise) @ shown)
    return agrees(own.raw, of_place, state.cameras[camera])


def _displacement(state: State, camera: int) -> Array | None:
    """(6, 6) covariance of a camera's pose at the present place about its estimate.

    By what places share, and what the estimate has of the noise of frames. None where nothing is
    stated of places, there is no other place, or the estimate is not determined.
    """
    n, rows, here = len(state.cameras), pose_rows(camera), state.live_frames[-1].place
    by_places = _shift(state, _counts(state.live_frames, n), {here: np.eye(n)[camera]})[rows, rows]
    if not by_places.any():
        return None
    sums = posterior(state)
    if not is_determined(sums.hessian[camera]):
        return None
    return np.asarray(by_places + sums.covariance(camera) * state.inflation(camera))


def _sandwich(hessian: Array, scatter: Array) -> Array:
    """(6, 6) covariance of a pose from the scatter of its gradient."""
    inverse = np.linalg.inv(hessian)
    return np.asarray(inverse @ scatter @ inverse)


def _gain(covariance: Array, noise: Array) -> Array:
    """(6, 6) share of a step with this noise by which a pose of this covariance follows it."""
    return np.asarray(np.linalg.solve(covariance + noise, covariance).T)


def _frame_noise(places: PlaceSums, camera: int, own: OutlierFrame, hessian: Array) -> Array:
    """(6, 6) scatter of a frame's gradient about the mean of its place; of few frames, as usual."""
    scatter, left = places.within_places
    if left[camera] >= LEAST_FRAMES:
        return np.asarray(scatter[camera] / left[camera])
    alike = error_components().frame_correlation
    return (1.0 + alike * (len(own.raw.frame) - 1.0)) * hessian


def _frame_hessian(state: State, camera: int, own: OutlierFrame) -> Array:
    """(6, 6) of a frame's matches within the gate about the T_lidar_camera that fits them."""
    scale = state.cameras[camera].scale
    residuals = own.raw.at(to_T_camera_lidar(own.T_lidar_camera))
    block = own.raw.select(residuals.inliers(scale)).with_scale(scale)
    return true_hessian(residuals, block, scale)


def _shift(state: State, first: dict[str, Array], second: dict[str, Array]) -> Array:
    """(6 n, 6 n) as of :func:`shift_between`, by (n,) numbers of frames per place."""
    n, findings = len(state.cameras), state.findings
    of_cloud = np.square([findings.place_rotation_rad, findings.place_translation_m])
    if not (findings.place_variance or of_cloud.any()):
        return np.zeros((6 * n, 6 * n))
    older = dict(zip(state.places.names, state.places.frames, strict=True))
    names = {**older, **first, **second}
    none = np.zeros(n)
    one = np.array([older.get(name, none) + first.get(name, none) for name in names])
    two = np.array([second.get(name, none) for name in names])
    flat = np.concatenate([*map(adjoint_camera_lidar, state.references)])
    by_cloud = flat @ (state.sizes.cloud * pose_covariance(*of_cloud)) @ flat.T
    of_frame = state.total_hessian / np.maximum(state.total_frames, 1.0)[:, None, None]
    own = np.asarray(findings.place_variance * np.linalg.inv(of_frame + WEAK))
    return shift_covariance(one, two, by_cloud, own)


def shift_covariance(before: Array, after: Array, by_cloud: Array, own: Array) -> Array:
    """(6 n, 6 n) covariance of the steps between two sets of frames by what places share.

    Frames of the same place share their errors, which cancel.

    Args:
        before: (P, n) numbers of frames of the first set, per place and camera.
        after: (P, n) of the second.
        by_cloud: (6 n, 6 n) of all cameras, by the cloud's displacement at a place.
        own: (n, 6, 6) of each camera at a place besides.
    """
    apart = before / np.maximum(before.sum(axis=0), 1.0)
    apart = apart - after / np.maximum(after.sum(axis=0), 1.0)
    both = apart.T @ apart
    found = np.kron(both, np.ones((6, 6))) * by_cloud
    for camera, covariance in enumerate(own):
        rows = pose_rows(camera)
        found[rows, rows] += both[camera, camera] * covariance
    return np.asarray(found)


def _counts(frames: Iterable[LiveFrame], cameras: int) -> dict[str, Array]:
    """(n,) frames with matches of each camera, per place."""
    found: dict[str, Array] = {}
    for frame in frames:
        counts = found.setdefault(frame.place, np.zeros(cameras))
        for camera in frame.raw:
            counts[camera] += 1
    return found
