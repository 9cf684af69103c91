"""Rigs that are wrong in one way, for the cases of ``accuracy.verdicts``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph import Camera, RelativePose, Rig
from calibgraph.model.geometry import invert, relative_transform

Array = np.ndarray
Rng = np.random.Generator

STEREO_SIGMA_DEG, STEREO_SIGMA_M = 0.1, 0.01


def with_lenses(rig: Rig, change: Callable[[Camera], dict[str, Any]]) -> Rig:
    """The rig with some fields of every camera changed."""
    fields = Camera.model_fields
    cameras = {
        name: Camera(**{**{field: getattr(camera, field) for field in fields}, **change(camera)})
        for name, camera in rig.cameras.items()
    }
    return rig.model_copy(update={"cameras": cameras})


def with_focal(rig: Rig, factor: float) -> Rig:
    """The rig with focal lengths that are wrong by a factor."""

    def change(camera: Camera) -> dict[str, Any]:
        k = camera.intrinsics_px
        return {"intrinsics_px": k.model_copy(update={"fx": factor * k.fx, "fy": factor * k.fy})}

    return with_lenses(rig, change)


def with_focal_y(rig: Rig, factor: float) -> Rig:
    """The rig with fy alone wrong by a factor."""

    def change(camera: Camera) -> dict[str, Any]:
        k = camera.intrinsics_px
        return {"intrinsics_px": k.model_copy(update={"fy": factor * k.fy})}

    return with_lenses(rig, change)


def with_principal_point(rig: Rig, offset_px: Array) -> Rig:
    """The rig with principal points that are wrong by an offset (2,)."""

    def change(camera: Camera) -> dict[str, Any]:
        k = camera.intrinsics_px
        moved = {"cx": k.cx + offset_px[0], "cy": k.cy + offset_px[1]}
        return {"intrinsics_px": k.model_copy(update=moved)}

    return with_lenses(rig, change)


def random_offset(rng: Rng, least: float, most: float) -> Array:
    """(2,) of a random size between two bounds, in a random direction."""
    size, angle = rng.uniform(least, most), rng.uniform(0, 2 * np.pi)
    return size * np.array([np.cos(angle), np.sin(angle)])


def with_half_resolution(rig: Rig) -> Rig:
    """The rig with the intrinsics of images of half the size."""

    def change(camera: Camera) -> dict[str, Any]:
        k = camera.intrinsics_px
        half = {name: getattr(k, name) / 2 for name in ("fx", "fy", "cx", "cy")}
        return {"intrinsics_px": k.model_copy(update=half)}

    return with_lenses(rig, change)


def with_stereo(rig: Rig, truth: Rig, a: str, b: str) -> Rig:
    """The rig with the true relative pose of two cameras in its file, as a stereo calibration."""
    T = truth.T_camera_lidar
    pair = RelativePose(
        a=a,
        b=b,
        T_a_b=relative_transform(T[a], T[b]),
        rotation_sigma_rad=np.radians(STEREO_SIGMA_DEG),
        translation_sigma_m=STEREO_SIGMA_M,
    )
    return rig.model_copy(update={"relative_poses": (pair,)})


def invert_extrinsics(rig: Rig) -> Rig:
    """The rig with T_lidar_camera where T_camera_lidar should be."""
    return rig.moved_to({name: invert(T) for name, T in rig.T_camera_lidar.items()})


def to_transform(angles_deg: Array, shift_m: Array) -> Array:
    """(4, 4) from a rotation vector [deg] and a shift [m]."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(angles_deg)).as_matrix()
    T[:3, 3] = shift_m
    return T


def compose_extrinsics(rig: Rig, T_lidar_points: Array) -> Rig:
    """The rig, T_camera_lidar T_lidar_points: points come from another LiDAR frame."""
    return rig.moved_to({name: T @ T_lidar_points for name, T in rig.T_camera_lidar.items()})


def random_sign(rng: Rng) -> float:
    """Plus or minus one."""
    return float(rng.choice([-1.0, 1.0]))


def derangement(count: int, rng: Rng) -> Array:
    """A random permutation without fixed points."""
    while True:
        order = rng.permutation(count)
        if (order != np.arange(count)).all():
            return order
