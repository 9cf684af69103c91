"""Wrong intrinsics leave a pattern in the residuals: of focal lengths, principal point, distortion.

Each is a field of displacements over the image. It is estimated together with the extrinsic; the
check is how far the camera moves when it is set free, and with which significance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.rig import Camera
from calibgraph.model.verdict import Check, grade
from calibgraph.parallel import map_on_cores
from calibgraph.solver.augmented_fit import AugmentedFit, linearize_block
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.residual_scale import ResidualScale
from calibgraph.trust.evidence import Checks, Evidence
from calibgraph.trust.thresholds import limit, threshold

Array = NDArray[np.float64]

_LIMITS = {
    "focal length": (limit("focal_sigmas"), limit("focal_fail")),
    "principal point": (limit("centre_sigmas"), limit("centre_fail")),
    "distortion": (limit("distortion_sigmas"), limit("distortion_fail")),
    "aspect ratio": (limit("focal_sigmas"), limit("shape_fail")),
    "skew": (limit("focal_sigmas"), limit("shape_fail")),
}
"""Per lens parameter: from how many sigmas on it counts, and the largest value that cannot fail."""

_SHAPES = ("aspect ratio", "skew")

_FIELDS = 6  # of displacements, see ``fill_displacement_fields``
_MAX_MATCHES = 20_000  # evenly chosen: bounds the time


@dataclass(frozen=True, eq=False)
class FreedParameter:
    """The estimate of one lens parameter together with the extrinsic.

    Attributes:
        name: "focal length", "principal point", "distortion", "aspect ratio" or "skew".
        values: (k,) estimates: relative change of the focal length; shift of the principal point
            [px]; relative radial displacement at one focal length from the centre; relative change
            of fx / fy; change of the skew, in parts of fx.
        sigmas: (k,) their standard deviations, frames as clusters.
        moved_deg: how far the camera turns.
        moved_cm: how far the camera's centre moves.
    """

    name: str
    values: Array
    sigmas: Array
    moved_deg: float
    moved_cm: float

    @cached_property
    def largest(self) -> float:
        """The largest of the values."""
        return float(np.abs(self.values).max())

    @property
    def is_misshapen(self) -> bool:
        """Whether pixels would not be square, by more than lenses are."""
        return self.name in _SHAPES and self.largest > limit("shape_warn")

    @cached_property
    def significance(self) -> float:
        """The largest of the values in its standard deviations."""
        return float(np.max(np.abs(self.values) / np.maximum(self.sigmas, np.finfo(float).tiny)))


def intrinsics_checks(evidence: Evidence) -> Checks:
    """Whether wrong intrinsics explain the residuals, and how much depends on the focal length."""
    solution = evidence.of_correspondences.solution
    cameras = solution.solved_rig.cameras

    def of_camera(name: str) -> list[Check]:
        return check_intrinsics(cameras[name], evidence.fitted_blocks[name], solution.scales[name])

    names = [*evidence.fitted_blocks]
    return dict(zip(names, map_on_cores(of_camera, names), strict=True))


def check_intrinsics(camera: Camera, block: CameraBlock, scale: ResidualScale) -> list[Check]:
    """The checks of one camera's intrinsics.

    Args:
        camera: lens, and the solution's extrinsic.
        block: all of the camera's matches, not only those within the gate.
        scale: of their residuals.
    """
    some = block.select_evenly(_MAX_MATCHES)
    errors_px, in_front = some.errors_px(camera.T_camera_lidar)
    # At the predicted pixels: at the observed ones, a focal length doubled and all points in the
    # centre would explain everything.
    rows = linearize_block(
        camera, some.select(in_front), _FIELDS, partial(fill_displacement_fields, camera)
    )
    unknowns = {
        "focal length": (0,),
        "principal point": (1, 2),
        "distortion": (3,),
        "aspect ratio": (4,),
        "skew": (5,),
    }
    checks = [
        _check_freed(_free(name, fit))
        for name, numbers in unknowns.items()
        if (fit := rows.fit(numbers, loss_scale=scale.loss_scale))
    ]
    inside = (errors_px <= scale.gate_px)[in_front].astype(np.float64)
    twists = rows.compensating_twists(unknowns["focal length"], inside)
    return [*checks, _check_sensitivity(twists[:, 0])]


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


def _free(name: str, fit: AugmentedFit) -> FreedParameter:
    """exp(twist) turns the camera by its rotation's length, and moves the centre by the other's."""
    degrees = float(np.degrees(np.linalg.norm(fit.twist[:3])))
    centimetres = 100 * float(np.linalg.norm(fit.twist[3:]))
    return FreedParameter(name, fit.values, fit.sigmas, degrees, centimetres)


def _check_freed(freed: FreedParameter) -> Check:
    """How far a significant lens parameter turns or moves the camera, whichever is worse.

    A value as small as intrinsics are known by is at most a warning; so is a principal point, which
    is hard to distinguish from a rotation. An aspect ratio or skew as no lens has it is one also if
    set free it moves the camera little: matches from rounds have followed it.
    """
    min_sigmas, fail_size = _LIMITS[freed.name]
    significant = freed.significance > min_sigmas
    degrees, centimetres = (freed.moved_deg, freed.moved_cm) if significant else (0.0, 0.0)
    moves = {threshold("lens_rotation"): degrees, threshold("lens_translation"): centimetres}
    statuses = {row.grade(move) for row, move in moves.items()}
    warn = statuses != {"PASS"} or (significant and freed.is_misshapen)
    fail = freed.largest > fail_size and ("FAIL" in statuses or (warn and freed.is_misshapen))
    text = (
        f"residuals over the image: {_describe(freed)} ({freed.significance:.2g} sigma) would move "
        f"the camera by {freed.moved_deg:.2g} deg, {freed.moved_cm:.2g} cm"
    )
    if warn:
        text += "; check the intrinsics, and that images are not undistorted twice"
    status = grade(warn, fail)
    checks = [
        row.describe(move, status, text, name=f"{freed.name}: {row.name}")
        for row, move in moves.items()
    ]
    worse = max(checks, key=lambda check: check.severity)
    return replace(worse, kind=f"lens_{freed.name.replace(' ', '_')}")


def _check_sensitivity(twist: Array) -> Check:
    """How far a focal length wrong by one percent, easily overlooked, moves the camera.

    Args:
        twist: (6,) by which its pose compensates for a unit relative change of the focal length.
    """
    row = threshold("focal_sensitivity")
    if np.isnan(twist).any():
        return row.describe(np.nan, "WARN", "matches within the gate do not determine the camera")
    return row.check(0.01 * 100 * float(np.linalg.norm(twist[3:])))


def _describe(freed: FreedParameter) -> str:
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
