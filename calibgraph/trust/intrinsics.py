"""Wrong intrinsics leave a pattern in the residuals: the posterior of a free lens, by the matches.

The solution's own matches, linearized there with pose and lens free. The check is the probability
that a parameter is wrong and displaces the camera by more than users tolerate.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.rig import Camera
from calibgraph.model.verdict import TOLERANCE, Check
from calibgraph.parallel import map_on_cores
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.linear_fit import fit_linear, linearize
from calibgraph.solver.residual_scale import ResidualScale
from calibgraph.trust.evidence import Checks, Evidence
from calibgraph.trust.lens_parameter import (
    ASPECT_NUMBER,
    FOCAL_NUMBER,
    RADIAL_NUMBER,
    RESIDUALS,
    SKEW_NUMBER,
    X_NUMBER,
    Y_NUMBER,
    LensParameter,
    check_parameter,
    lens_fields_px,
    lens_variable,
)
from calibgraph.trust.thresholds import limit, threshold

Array = NDArray[np.float64]

_UNKNOWNS = {
    "focal length": (FOCAL_NUMBER,),
    "principal point": (X_NUMBER, Y_NUMBER),
    "distortion": (RADIAL_NUMBER,),
    "aspect ratio": (ASPECT_NUMBER,),
    "skew": (SKEW_NUMBER,),
}
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

    names = [n for n in evidence.fitted_blocks if cameras[n].model != "equirectangular"]
    return dict(zip(names, map_on_cores(of_camera, names), strict=True))


def check_intrinsics(
    camera: Camera,
    block: CameraBlock,
    scale: ResidualScale,
    of_place: float = 0.0,
    *,
    tolerance: tuple[float, float] = TOLERANCE,
) -> list[Check]:
    """The checks of one camera's intrinsics; its format does not determine the lens.

    Args:
        camera: lens, and the solution's extrinsic.
        block: all of the camera's matches, not only those within the gate.
        scale: of their residuals.
        of_place: variance of what the frames of a place share, over that of all matches, if they
            were independent. It is taken for at least that of a small share of each match.
        tolerance: of the user [deg, cm].
    """
    some = block.select_evenly(_MAX_MATCHES)
    seen = some.select(some.errors_px(camera.T_camera_lidar)[1])
    columns = linearize(camera, seen.block, lens_fields_px(camera, seen.block.points_lidar_m))
    shared = max(of_place, limit("lens_match_share") * len(some))
    fit = fit_linear(
        columns, seen.frame_counts, loss_scale=scale.loss_scale, shared_variance=shared
    )
    if fit is None:
        return []
    found = {name: fit.free(*numbers) for name, numbers in _UNKNOWNS.items()}
    checks = [
        check_parameter(LensParameter.of(name, camera, found[name], numbers), RESIDUALS)
        for name, numbers in _UNKNOWNS.items()
    ]
    sigma = lens_variable(camera).free.sigmas[FOCAL_NUMBER]
    per_unit = found["focal length"].compensating[:, 0] / sigma
    return [*checks, _check_sensitivity(per_unit, tolerance)]


def _check_sensitivity(twist: Array, tolerance: tuple[float, float]) -> Check:
    """How far a focal length wrong by one percent, easily overlooked, moves the camera.

    Args:
        twist: (6,) by which its pose compensates for a unit relative change of the focal length.
        tolerance: of the user [deg, cm].
    """
    row = threshold("focal_sensitivity", tolerance)
    return row.check(0.01 * 100 * float(np.linalg.norm(twist[3:])))
