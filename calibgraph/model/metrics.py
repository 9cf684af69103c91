"""The paper's protocol: perturbed guesses, T_init = T_delta T_GT; and its metrics of estimates."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from calibgraph.arrays import Array
from calibgraph.errors import RigError
from calibgraph.model.geometry import angle_deg, relative_transform, transform, twist_between
from calibgraph.model.lens import corner_distance_px, has_other_lens
from calibgraph.model.rig import Camera, Rig


@dataclass(frozen=True)
class PoseError:
    """Difference of two rigid transforms (paper, "Evaluation Metrics").

    Attributes:
        rotation_error_deg: E_R, the angle of Delta R = R_est R_ref^T.
        translation_error_cm: E_t = |t_est - t_ref|.
        x_cm, y_cm, z_cm: t_est - t_ref, signed, along the camera's axes.
        roll_deg, pitch_deg, yaw_deg: Delta R as signed rotations about the axes that these words
            mean for a vehicle looking along the camera's z axis: roll about z (forward), pitch
            about x (right), yaw about y (down); components of its rotation vector.
    """

    rotation_error_deg: float
    translation_error_cm: float
    x_cm: float
    y_cm: float
    z_cm: float
    roll_deg: float
    pitch_deg: float
    yaw_deg: float


@dataclass(frozen=True)
class Deviation:
    """A difference of two transforms over its standard deviation, of a reference with error bars.

    Attributes:
        rotation, translation: of xi in T_est = exp(xi) T_ref, about and along the camera's x, y, z.
        p: probability of a difference as unlikely as this one if both error bars hold, chi-square
            of six numbers.
        of: whose error bars count.
    """

    rotation: tuple[float, float, float]
    translation: tuple[float, float, float]
    p: float
    of: Literal["reference", "both"]


@dataclass(frozen=True)
class Evaluation:
    """Errors of all cameras, and of all pairs.

    The pair ``"A->B"`` is T_B_A = T_B_lidar T_A_lidar^-1, which maps coordinates in A to
    coordinates in B; its errors are along the axes of B. ``deviations`` are of the cameras whose
    reference has a covariance. ``lens_px`` is :func:`calibgraph.model.lens.corner_distance_px`, of
    cameras whose lenses differ; times are differences of those that both rigs state.
    """

    cameras: dict[str, PoseError]
    pairs: dict[str, PoseError]
    deviations: dict[str, Deviation] = field(default_factory=dict)
    lens_px: dict[str, float] = field(default_factory=dict)
    time_offset_ms: dict[str, float] = field(default_factory=dict)
    readout_ms: dict[str, float] = field(default_factory=dict)


def evaluate(
    estimate: Rig, reference: Rig, covariance: Mapping[str, Array | None] | None = None
) -> Evaluation:
    """Compare the extrinsics of two rigs.

    Args:
        estimate: to evaluate.
        reference: its covariances, where it has any, give the deviations.
        covariance: per camera of the estimate, (6, 6) of xi in T_camera_lidar = exp(xi) estimate;
            the estimate's own rig if None.

    Raises:
        RigError: if a camera of the estimate is not in the reference.
    """
    for name in estimate.require_cameras().cameras:
        if name not in reference.cameras:
            raise RigError(
                f"camera {name!r} of the estimate is not in the reference, which has "
                f"{', '.join(map(repr, reference.cameras))}; give it the same name in both",
                camera=name,
            )
    found, true = estimate.T_camera_lidar, reference.T_camera_lidar
    cameras = {name: pose_error(found[name], true[name]) for name in found}
    pairs = {
        f"{a}->{b}": pose_error(
            relative_transform(found[b], found[a]), relative_transform(true[b], true[a])
        )
        for a, b in combinations(found, 2)
    }
    if covariance is None:
        covariance = {name: camera.covariance for name, camera in estimate.cameras.items()}
    both = [(name, new, reference.cameras[name]) for name, new in estimate.cameras.items()]
    deviations = {
        name: deviation(new.T_camera_lidar, old, covariance.get(name))
        for name, new, old in both
        if old.covariance is not None
    }
    lens_px = {n: corner_distance_px(old, new) for n, new, old in both if has_other_lens(old, new)}
    offsets = {name: (new.time_offset_s, old.time_offset_s) for name, new, old in both}
    readouts = {name: (new.readout_s, old.readout_s) for name, new, old in both}
    return Evaluation(cameras, pairs, deviations, lens_px, _later_ms(offsets), _later_ms(readouts))


def _later_ms(times_s: Mapping[str, tuple[float | None, float | None]]) -> dict[str, float]:
    """Difference of two times, of the cameras of which both are stated."""
    both = times_s.items()
    return {n: 1e3 * (new - old) for n, (new, old) in both if new is not None and old is not None}


def deviation(estimate: Array, reference: Camera, covariance: Array | None) -> Deviation:
    """Difference of a (4, 4) T_camera_lidar from a reference, in standard deviations.

    Of the reference's covariance, and of that of the estimate, (6, 6), if it is known.
    """
    xi = twist_between(estimate, reference.T_camera_lidar)
    total = np.array(reference.covariance)
    if covariance is not None:
        total += covariance
    z = (xi / np.sqrt(np.diag(total))).tolist()
    p = float(chdtrc(len(xi), xi @ np.linalg.solve(total, xi)))
    return Deviation(
        (z[0], z[1], z[2]), (z[3], z[4], z[5]), p, "reference" if covariance is None else "both"
    )


def pose_error(estimate: Array, reference: Array) -> PoseError:
    """Difference of two (4, 4) transforms into the same camera."""
    rotation = estimate[:3, :3] @ reference[:3, :3].T
    shift = 100.0 * (estimate[:3, 3] - reference[:3, 3])
    about_x, about_y, about_z = np.degrees(Rotation.from_matrix(rotation).as_rotvec())
    x, y, z = shift.tolist()
    length, turns = float(np.linalg.norm(shift)), (float(about_z), float(about_x), float(about_y))
    return PoseError(angle_deg(rotation), length, x, y, z, *turns)


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
    if not (0 <= rotation_deg <= 180 and 0 <= translation_m < math.inf):  # noqa: PLR2004
        raise ValueError(
            f"expected an angle within 0 to 180 deg and a length >= 0 m, found {rotation_deg} deg "
            f"and {translation_m} m"
        )
    rng, draw = np.random.default_rng(seed), _draw_uniform if uniform else _draw_exact
    extrinsics = rig.T_camera_lidar.items()
    return rig.moved_to({n: draw(rng, rotation_deg, translation_m) @ T for n, T in extrinsics})


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
