"""Wrong intrinsics leave a pattern in the residuals: of focal lengths, principal point, distortion.

Each is a field of displacements over the image. It is estimated together with the extrinsic; the
check is the probability that it is wrong and displaces the camera by more than users tolerate.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.rig import Camera
from calibgraph.model.verdict import TOLERANCE, Check
from calibgraph.parallel import map_on_cores
from calibgraph.solver.augmented_fit import AugmentedFit, linearize_block
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.residual_scale import ResidualScale
from calibgraph.trust.evidence import Checks, Evidence
from calibgraph.trust.lens_parameter import RESIDUALS, LensParameter, check_parameter
from calibgraph.trust.thresholds import limit, threshold

Array = NDArray[np.float64]

_UNKNOWNS = {
    "focal length": (0,),
    "principal point": (1, 2),
    "distortion": (3,),
    "aspect ratio": (4,),
    "skew": (5,),
}
"""Numbers of the fields of displacements, see ``fill_displacement_fields``."""

_FIELDS = 6
_MAX_MATCHES = 20_000  # evenly chosen: bounds the time


def intrinsics_checks(evidence: Evidence) -> Checks:
    """Whether wrong intrinsics explain the residuals, and how much depends on the focal length."""
    solution = evidence.of_correspondences.solution
    cameras = solution.solved_rig.cameras
    findings, places = evidence.findings, solution.correspondences.places

    def of_camera(name: str) -> list[Check]:
        block = evidence.fitted_blocks[name]
        of_place = findings.place_variance * places.frames_per_place(block.frame_numbers)
        scale, tolerance = solution.scales[name], solution.config.tolerance
        return check_intrinsics(cameras[name], block, scale, of_place, tolerance=tolerance)

    names = [*evidence.fitted_blocks]
    return dict(zip(names, map_on_cores(of_camera, names), strict=True))


def check_intrinsics(
    camera: Camera,
    block: CameraBlock,
    scale: ResidualScale,
    of_place: float = 0.0,
    *,
    tolerance: tuple[float, float] = TOLERANCE,
) -> list[Check]:
    """The checks of one camera's intrinsics.

    Args:
        camera: lens, and the solution's extrinsic.
        block: all of the camera's matches, not only those within the gate.
        scale: of their residuals.
        of_place: variance of what the frames of a place share, over that of all matches, if they
            were independent. It is taken for at least that of a small share of each match.
        tolerance: of the user [deg, cm].
    """
    some = block.select_evenly(_MAX_MATCHES)
    errors_px, in_front = some.errors_px(camera.T_camera_lidar)
    # At the predicted pixels: at the observed ones, a focal length doubled and all points in the
    # centre would explain everything.
    rows = linearize_block(
        camera, some.select(in_front), _FIELDS, partial(fill_displacement_fields, camera)
    )
    shared = max(of_place, limit("lens_match_share") * len(some))
    checks = [
        check_parameter(freed := _free(name, fit, camera), RESIDUALS, _describe(freed))
        for name, numbers in _UNKNOWNS.items()
        if (fit := rows.fit(numbers, loss_scale=scale.loss_scale, shared_variance=shared))
    ]
    inside = (errors_px <= scale.gate_px)[in_front].astype(np.float64)
    twists = rows.compensating_twists(_UNKNOWNS["focal length"], inside)
    return [*checks, _check_sensitivity(twists[:, 0], tolerance)]


def fill_displacement_fields(camera: Camera, pixels_px: Array, fields: Array) -> None:
    """Displacements [px] of pixels per unit of each lens parameter's values.

    Args:
        camera: its lens.
        pixels_px: (2, n).
        fields: (6, 2, n), filled: of the focal length, the principal point (two), the distortion,
            the aspect ratio and the skew.
    """
    k = camera.intrinsics_px
    u, v = np.subtract(pixels_px, [[k.cx], [k.cy]], out=fields[0])
    fields[1, 0], fields[1, 1], fields[2, 0], fields[2, 1] = 1.0, 0.0, 0.0, 1.0
    np.multiply(fields[0], (u / k.fx) ** 2 + (v / k.fy) ** 2, out=fields[3])
    np.multiply(fields[0], [[0.5], [-0.5]], out=fields[4])
    fields[5, 0], fields[5, 1] = v * (k.fx / k.fy), 0.0


def _free(name: str, fit: AugmentedFit, camera: Camera) -> LensParameter:
    k = camera.intrinsics_px
    unit = np.array([k.fx, k.fy]) if name == "principal point" else np.ones(1)
    return LensParameter(name, fit.values, fit.sigmas, unit, fit.twist)


def _check_sensitivity(twist: Array, tolerance: tuple[float, float]) -> Check:
    """How far a focal length wrong by one percent, easily overlooked, moves the camera.

    Args:
        twist: (6,) by which its pose compensates for a unit relative change of the focal length.
        tolerance: of the user [deg, cm].
    """
    row = threshold("focal_sensitivity", tolerance)
    if np.isnan(twist).any():
        return row.describe(np.nan, "WARN", "matches within the gate do not determine the camera")
    return row.check(0.01 * 100 * float(np.linalg.norm(twist[3:])))


def _describe(freed: LensParameter) -> str:
    if freed.name == "focal length":
        longer = "longer" if freed.values[0] > 0 else "shorter"
        return f"a focal length {abs(freed.values[0]):.2%} {longer}"
    if freed.name == "principal point":
        return f"a principal point off by ({freed.values[0]:.3g}, {freed.values[1]:.3g}) px"
    if freed.name == "aspect ratio":
        larger = "larger" if freed.values[0] > 0 else "smaller"
        return f"a ratio fx / fy {abs(freed.values[0]):.2%} {larger}"
    if freed.name == "skew":
        return f"a skew of {freed.values[0]:.2g} fx"
    return f"radial distortion of {freed.values[0]:.2g} more"
