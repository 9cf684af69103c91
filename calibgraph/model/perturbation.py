"""Perturbed initial guesses: the paper's protocol, T_init = T_delta T_GT."""

import math
from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.model.geometry import transform
from calibgraph.model.rig import Rig


def perturb(
    rig: Rig, *, rotation_deg: float, translation_m: float, seed: int = 0, uniform: bool = False
) -> Rig:
    """Displace every camera independently: T_camera_lidar becomes T_delta T_camera_lidar.

    Args:
        rig: its extrinsics are displaced.
        rotation_deg: the angle, about a random axis.
        translation_m: the length, in a random direction.
        seed: of the draws; cameras are drawn in the rig's order.
        uniform: draw each of the six components uniformly within +- the value instead, the
            rotation as Euler angles about the camera's x, y, z axes.

    Raises:
        ValueError: if an angle or length is out of range.
    """
    return rig.moved_to(
        perturb_extrinsics(
            rig.T_camera_lidar,
            rotation_deg=rotation_deg,
            translation_m=translation_m,
            seed=seed,
            uniform=uniform,
        )
    )


def perturb_extrinsics(
    T_camera_lidar: Mapping[str, Array],
    *,
    rotation_deg: float,
    translation_m: float,
    seed: int = 0,
    uniform: bool = False,
) -> dict[str, Array]:
    """Like :func:`perturb`, for (4, 4) T_camera_lidar by camera."""
    if not (0 <= rotation_deg <= 180 and 0 <= translation_m < math.inf):  # noqa: PLR2004
        raise ValueError(
            f"expected an angle within 0 to 180 deg and a length >= 0 m, found {rotation_deg} deg "
            f"and {translation_m} m"
        )
    rng = np.random.default_rng(seed)
    draw = _draw_uniform if uniform else _draw_exact
    return {name: draw(rng, rotation_deg, translation_m) @ T for name, T in T_camera_lidar.items()}


def _draw_exact(rng: np.random.Generator, rotation_deg: float, translation_m: float) -> Array:
    """(4, 4) T_delta of exactly this angle and length, about and along random directions."""
    axis, direction = rng.standard_normal((2, 3))
    turn = Rotation.from_rotvec(np.radians(rotation_deg) * axis / np.linalg.norm(axis))
    return transform(turn, translation_m * direction / np.linalg.norm(direction))


def _draw_uniform(rng: np.random.Generator, rotation_deg: float, translation_m: float) -> Array:
    """(4, 4) T_delta with six components uniform within these values."""
    angles, shift = rng.uniform(-1.0, 1.0, (2, 3))
    turn = Rotation.from_euler("xyz", rotation_deg * angles, degrees=True)
    return transform(turn, translation_m * shift)
