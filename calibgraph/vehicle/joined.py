"""Cameras and several LiDARs: clouds joined for cameras, and LiDARs that only cameras join.

Where the base alone shows cameras too little, these are matched with the clouds of all LiDARs.

Clouds are joined in the base, by the poses found, whose errors are a part of those of cameras
(``matching.joined_clouds``). So cameras and LiDARs have one covariance.

LiDARs that share nothing may show the same cameras. Each camera i is then calibrated to both, and
T_base_lidar = T_i_base^-1 T_i_lidar with the error Ad(T_i_base^-1) (xi_i_lidar - xi_i_base): the
estimate is the mean over cameras, weighted by the covariance of these.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from calibgraph.arrays import Array, name_cells
from calibgraph.errors import CalibrationError
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.io.frame import Frame
from calibgraph.model.calibration import Calibration
from calibgraph.model.geometry import (
    adjoints,
    invert,
    retract_all,
    rows_of_poses,
    twist_between,
)
from calibgraph.model.rig import Camera, Rig
from calibgraph.vehicle.lidars import LidarPoses
from calibgraph.vehicle.sums import step_twists

Cloud = NDArray[np.float32]

_LEAST_SEEN = 0.7
"""Share of the cells that all LiDARs show a camera, which the base shows: with less, clouds are
joined. Of two LiDARs with 64 beams, on the roof and at the bumper, whose clouds joined gain little,
it is 0.78 to 0.97; of a camera at the edge of the base's view 0.5."""
_CELLS, _LEAST_CELLS = (24, 15), 36  # of an image; of these, so that a camera can be calibrated
_FRAMES = 3  # that are looked at
_SURE = 2.0  # standard deviations of a pose that the tolerance allows


def join_clouds(
    data: Dataset, rig: Rig, poses: LidarPoses, tolerance: tuple[float, float]
) -> tuple[Dataset, str]:
    """The dataset with the clouds of LiDARs that are well known joined; why, empty if they are not.

    Args:
        data: its frames have the clouds of all LiDARs, or of some.
        rig: with the guess of the cameras.
        poses: of the LiDARs.
        tolerance: [deg, cm] of the verdict: of a LiDAR, two standard deviations are within.
    """
    most = np.array([np.radians(tolerance[0]), tolerance[1] / 100.0]) / _SURE
    joined = {
        name: poses.T_base_lidar[name]
        for name, covariance in poses.covariance.items()
        if (np.sqrt(np.diag(covariance)).reshape(2, 3).max(axis=1) <= most).all()
    }
    frames = tuple(
        replace(f, joined={n: T for n, T in joined.items() if n in f.lidar_paths}, kept=None)
        for f in data.frames
    )
    if not rig.cameras or not any(frame.joined for frame in frames):
        return data, ""
    shares = _shares_of_base(spread_out(frames, _FRAMES), rig)
    poor = {name: share for name, share in shares.items() if share < _LEAST_SEEN}
    if not poor:
        return data, ""
    seen = ", ".join(f"{name} {share:.0%}" for name, share in poor.items())
    line = f"clouds of {rig.lidar}, {', '.join(joined)} are joined for cameras, since {rig.lidar} "
    line += f"alone shows of what all show: {seen}"
    return replace(data, frames=frames, lidar_errors=lidar_errors(poses)), line


def lidar_errors(poses: LidarPoses) -> dict[str, Array]:
    """Per LiDAR but the base, (6, 6 k) its twist by a standard deviation of each of the errors."""
    turns = step_twists(np.array([poses.T_base_lidar[name] for name in poses.covariance]))
    each = np.split(turns @ poses.root, len(poses.covariance))
    return dict(zip(poses.covariance, each, strict=True))


def place_by_cameras(
    calibrate: Callable[[Dataset, Rig], Calibration], data: Dataset, rig: Rig, name: str
) -> LidarPoses:
    """The pose of a LiDAR by cameras that see what it sees, and what the base sees.

    Args:
        calibrate: cameras to the one cloud of each frame, from where a rig has them.
        data: with the clouds of both.
        rig: with the guess of cameras, and of the LiDAR.
        name: of the LiDAR.

    Raises:
        CalibrationError: if no camera has been found in the clouds of both.
    """
    T_guess = rig.T_base_lidar[name]
    alone = rig.model_copy(update={"lidars": None, "vehicle": None})
    at_other = alone.moved_to({n: T @ T_guess for n, T in alone.T_camera_lidar.items()})
    sides = [
        (_with_frames(data, name, lambda frame: replace(frame, lidar_paths={})), alone),
        (_with_frames(data, name, lambda frame: _of_lidar(frame, name, T_guess)), at_other),
    ]
    both = [_cameras_in(side, of) for side, of in sides]
    seen = [camera for camera in rig.cameras if all(camera in of for of in both)]
    if not seen:
        raise CalibrationError(
            f"{rig.lidar} and {name} share no planes, and no camera sees what both see"
        )
    base, other = (calibrate(side, _with_cameras(of, seen)) for side, of in sides)
    found = [
        n for n in seen if all(side.covariance[n] is not None and side.verdicts[n].status != "FAIL"
                               for side in (base, other))
    ]  # fmt: skip
    if not found:
        raise CalibrationError(
            f"{rig.lidar} and {name} share no planes, and of the cameras that see what both see "
            f"({', '.join(seen)}) none is calibrated to both"
        )
    T_lidar_camera = invert(np.array([base.rig.T_camera_lidar[n] for n in found]))
    T = T_lidar_camera @ [other.rig.T_camera_lidar[n] for n in found]
    to_base = block_diag(*adjoints(T_lidar_camera))
    covariance = to_base @ (_joint(base, found) + _joint(other, found)) @ to_base.T
    T_base_lidar, own, ratio = _mean_pose(T, covariance)
    turn = np.linalg.inv(step_twists(T_base_lidar[None]))
    poses, joint = {rig.lidar: np.eye(4), name: T_base_lidar}, turn @ own @ turn.T
    return LidarPoses(rig.lidar, poses, joint, {}, len(data.frames), (ratio, ratio))


def _with_frames(data: Dataset, name: str, make: Callable[[Frame], Frame]) -> Dataset:
    """The dataset with each frame that has a LiDAR's cloud made another."""
    frames, recorded = (
        tuple(make(frame) for frame in of if name in frame.lidar_paths)
        for of in (data.frames, data.recorded)
    )
    return replace(data, frames=frames, recorded=recorded)


def _joint(result: Calibration, cameras: Sequence[str]) -> Array:
    """(6 n, 6 n) of some cameras; as independent where another one is not determined."""
    if result.joint_covariance is None:
        return np.asarray(block_diag(*(result.covariance[name] for name in cameras)))
    rows = rows_of_poses(cameras, [*result.rig.cameras])
    return np.asarray(result.joint_covariance[np.ix_(rows, rows)])


def _mean_pose(T: Array, covariance: Array) -> tuple[Array, Array, float]:
    """(4, 4) the mean of (n, 4, 4) estimates of one pose, its (6, 6) covariance, and a ratio.

    By the (6 n, 6 n) covariance of xi in exp(xi) T. The ratio is that by which their scatter is
    wider than it says, at least 1, and the covariance is wider by it.
    """
    weight, each = np.linalg.inv(covariance), np.tile(np.eye(6), (len(T), 1))
    apart = np.concatenate([twist_between(one, T[0]) for one in T])
    own = np.linalg.inv(each.T @ weight @ each)
    step = own @ each.T @ weight @ apart
    left = apart - each @ step
    ratio = max(1.0, float(left @ weight @ left) / max(6 * (len(T) - 1), 1))
    return np.asarray(retract_all(T[:1], -step[None])[0]), np.asarray(ratio * own), ratio


def _of_lidar(frame: Frame, name: str, T_base_lidar: Array) -> Frame:
    """The frame with the cloud of another LiDAR, which moves as the base does."""
    turn, motion = adjoints(invert(T_base_lidar)[None])[0], frame.motion
    own = replace(
        frame, cloud_path=frame.lidar_paths[name], lidar_paths={}, columns=None, find_motion=None,
        find_twist=None, kept=None,
    )  # fmt: skip
    if motion is None:
        return own
    twist = tuple((turn @ motion.twist_per_s).tolist())
    moved = replace(motion, twist_per_s=twist, T_world_lidar=None)
    return replace(own, find_motion=lambda: moved)


def _with_cameras(rig: Rig, names: Sequence[str]) -> Rig:
    """The rig with some of its cameras."""
    kept = [pair for pair in rig.relative_poses if {pair.a, pair.b} <= {*names}]
    cameras = {name: rig.cameras[name] for name in names}
    return rig.model_copy(update={"cameras": cameras, "relative_poses": tuple(kept)})


def _cameras_in(data: Dataset, rig: Rig) -> list[str]:
    """The cameras whose images have enough points."""
    clouds = [frame.load_cloud() for frame in spread_out(data.frames, _FRAMES)]
    least = _LEAST_CELLS * len(clouds)
    return [n for n, c in rig.cameras.items() if sum(_cells(c, cloud) for cloud in clouds) >= least]


def _shares_of_base(frames: Sequence[Frame], rig: Rig) -> dict[str, float]:
    """Per camera, the cells of its images with points of the base, over those with any."""
    clouds = [(replace(each, joined={}).load_cloud(), each.load_cloud()) for each in frames]
    found = {}
    for name, camera in rig.cameras.items():
        base, every = (
            sum(_cells(camera, cloud) for cloud in of) for of in zip(*clouds, strict=True)
        )
        found[name] = base / every if every else 1.0
    return found


def _cells(camera: Camera, cloud: Cloud) -> int:
    """How many cells of the image have points."""
    pixels, seen = camera.lens.project(cloud[:, :3].astype(np.float64), camera.T_camera_lidar)
    size = np.array([camera.width_px, camera.height_px])
    inside = pixels[seen & camera.in_image(pixels)]
    return len(np.unique(name_cells((inside + 0.5) / size * _CELLS)))


def joint_covariance(cameras: Array, by_lidars: Array, lidars: Array, root: Array) -> Array:
    """(6 N + 6 k) of cameras and LiDARs.

    Args:
        cameras: (6 N, 6 N) with the part by the poses of LiDARs.
        by_lidars: (6 N, 6 k) by a standard deviation of each error of these, or (6 N, 0).
        lidars: (6 k, 6 k) of them.
        root: (6 k, 6 k) by a standard deviation of each of the errors.
    """
    across = by_lidars @ root.T if by_lidars.size else np.zeros((len(cameras), len(lidars)))
    return np.block([[cameras, across], [across.T, lidars]])
