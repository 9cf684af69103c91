"""Hidden causes that leave a pattern in the residuals: wrong focal length, centre, distortion.

Each suspect is a field of displacements over the image. It is fitted together with the pose; what
counts is how far the pose moves when the suspect is set free, and how sure that is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.correspondences import Correspondences
from calibgraph.model.geometry import pose_difference
from calibgraph.model.rig import Camera
from calibgraph.model.verdict import Check, above, grade
from calibgraph.solver.augmented_fit import AugmentedFit, compensating_twists, fit_augmented
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.camera_twist import apply_twist, project_with_jacobian
from calibgraph.solver.residual_scale import ResidualScale

Array = NDArray[np.float64]

SURE_SIGMAS = {"focal length": 5.0, "principal point": 10.0, "distortion": 5.0}
FAIL_SIZES = {"focal length": 0.01, "principal point": np.inf, "distortion": 0.02}
MOVED_WARN_DEG, MOVED_FAIL_DEG = 0.15, 0.5
MOVED_WARN_CM, MOVED_FAIL_CM = 5.0, 10.0
"""How far a suspect that is sure may move the camera. With right intrinsics, on a recorded and on a
rendered scene: up to 4.2 sigma, 1.4 cm; the centre up to 7 sigma, 0.6 deg."""

SENSITIVITY_WARN_CM = 15.0
"""How far a focal length that is wrong by one percent may move the camera."""

MOST_MATCHES = 20_000


@dataclass(frozen=True, eq=False)
class Freed:
    """What setting one suspect free gives.

    Attributes:
        suspect: "focal length", "principal point" or "distortion".
        values: (k,) its fitted numbers: relative change of the focal length; shift of the centre
            [px]; relative radial displacement at one focal length from the centre.
        sigmas: (k,) their standard deviations, frames as clusters.
        moved_deg: how far the camera turns.
        moved_cm: how far the camera's centre moves.
    """

    suspect: str
    values: Array
    sigmas: Array
    moved_deg: float
    moved_cm: float

    @property
    def largest(self) -> float:
        """The largest of the values."""
        return float(np.abs(self.values).max())

    @property
    def surest(self) -> float:
        """The largest of the values in its standard deviations."""
        return float(np.max(np.abs(self.values) / np.maximum(self.sigmas, np.finfo(float).tiny)))


def suspects(camera: Camera, pixels_px: Array) -> dict[str, Array]:
    """Per suspect (n, 2, k): displacement [px] of pixels (n, 2) per unit of its numbers."""
    k = camera.intrinsics_px
    off = pixels_px - [k.cx, k.cy]
    ones, zeros = np.ones(len(off)), np.zeros(len(off))
    centre = np.stack([np.stack([ones, zeros], 1), np.stack([zeros, ones], 1)], axis=2)
    radius = np.hypot(off[:, 0] / k.fx, off[:, 1] / k.fy)[:, None]
    return {
        "focal length": off[:, :, None],
        "principal point": centre,
        "distortion": (off * radius**2)[:, :, None],
    }


def smell_checks(
    camera: Camera, matches: CameraBlock, scale: ResidualScale, T_camera_lidar: Array
) -> list[Check]:
    """Whether a wrong focal length, centre or distortion explains a camera's residuals.

    Args:
        camera: lens.
        matches: all of the camera's, not only those within the gate.
        scale: of their residuals.
        T_camera_lidar: the solution.
    """
    step = -(-len(matches.frame) // MOST_MATCHES)
    some = matches.select(np.arange(len(matches.frame)) % step == 0)
    at_solution = camera.moved_to(T_camera_lidar)
    errors_px, in_front = some.errors_px(T_camera_lidar)
    table = some.select(in_front).as_table(camera="camera")
    # At the predicted pixels: at the observed ones, a focal length doubled and all points in the
    # centre would explain everything.
    columns = suspects(camera, project_with_jacobian(at_solution, table.points_lidar_m)[0])
    checks = [
        _freed_check(_freed(name, fit, at_solution))
        for name, column in columns.items()
        if (fit := fit_augmented(at_solution, table, column, loss_scale=scale.loss_scale))
    ]
    inside = (errors_px <= scale.gate_px)[in_front]
    focal = columns["focal length"][inside]
    return [*checks, _sensitivity_check(at_solution, table.select(inside), focal)]


def _freed(name: str, fit: AugmentedFit, camera: Camera) -> Freed:
    moved = apply_twist(camera, fit.twist).T_camera_lidar
    degrees, centimetres = pose_difference(moved, camera.T_camera_lidar)
    return Freed(name, fit.values, fit.sigmas, degrees, centimetres)


def _freed_check(one: Freed) -> Check:
    """Judge a suspect by what it would move the camera by, where it is sure that it is not zero.

    If it is as small as intrinsics are ever known, it is worth a warning at most; so is a centre
    that is off, which is told from a turn so badly.
    """
    sure = one.surest > SURE_SIGMAS[one.suspect]
    moved_deg, moved_cm = (one.moved_deg, one.moved_cm) if sure else (0.0, 0.0)
    warn = moved_deg > MOVED_WARN_DEG or moved_cm > MOVED_WARN_CM
    fail = moved_deg > MOVED_FAIL_DEG or moved_cm > MOVED_FAIL_CM
    fail = fail and one.largest > FAIL_SIZES[one.suspect]
    text = (
        f"residuals over the image: {_in_words(one)} (by {one.surest:.2g} sigma) would move the "
        f"camera by {one.moved_deg:.2g} deg, {one.moved_cm:.2g} cm"
    )
    if warn or fail:
        text += "; check the intrinsics, and that images are not undistorted twice"
    name = f"{one.suspect}: would move the camera by"
    return Check(name, grade(warn, fail), text, moved_cm, MOVED_WARN_CM, MOVED_FAIL_CM, "cm")


def _sensitivity_check(camera: Camera, table: Correspondences, focal_px: Array) -> Check:
    """How much hangs on the focal length: what one percent that nobody notices would do."""
    twist = 0.01 * compensating_twists(camera, table, focal_px)[:, 0]
    _, centimetres = pose_difference(
        apply_twist(camera, twist).T_camera_lidar, camera.T_camera_lidar
    )
    return above(
        "a focal length wrong by 1 % would move the camera by",
        centimetres, SENSITIVITY_WARN_CM, np.inf, "cm",
        "be sure of the intrinsics, or give matches at more distances",
    )  # fmt: skip


def _in_words(one: Freed) -> str:
    if one.suspect == "focal length":
        return f"a focal length {abs(one.values[0]):.2%} {_MORE[bool(one.values[0] > 0)]}"
    if one.suspect == "principal point":
        return f"a principal point off by ({one.values[0]:.3g}, {one.values[1]:.3g}) px"
    return f"radial distortion of {one.values[0]:.2g} more"


_MORE = ("shorter", "longer")
