"""Wrong intrinsics leave a pattern in the residuals: the posterior of a free lens, by matches."""

from __future__ import annotations

from itertools import groupby

import numpy as np

from calibgraph.model.verdict import Check
from calibgraph.parallel import map_on_cores
from calibgraph.solver.linear_fit import Freed, LinearFit, fit_camera
from calibgraph.trust.evidence import Checks, Evidence
from calibgraph.trust.lens_parameter import (
    RESIDUALS,
    Free,
    LensParameter,
    check_parameter,
    lens_fields_px,
    units_of,
)
from calibgraph.trust.thresholds import limit, threshold

_NUMBERS = {
    "focal length": (Free.FOCAL,),
    "principal point": (Free.CENTRE_X, Free.CENTRE_Y),
    "distortion": (Free.RADIAL,),
    "aspect ratio": (Free.ASPECT,),
}
_MAX_MATCHES = 20_000  # evenly chosen: bounds the time


def intrinsics_checks(evidence: Evidence) -> Checks:
    """Whether wrong intrinsics explain the residuals, and how much depends on the focal length.

    By all matches, not only those within the gate. The variance of what the frames of a place share
    is taken for at least that of a small share of each match. Of a panorama the format determines
    the lens.
    """
    evidence = evidence.of_correspondences
    cameras = evidence.solution.solved_rig.cameras
    names = [n for n in evidence.fitted_blocks if cameras[n].model != "equirectangular"]
    checks = map_on_cores(lambda name: _check_camera(evidence, name), names)
    return dict(zip(names, checks, strict=True))


def _check_camera(evidence: Evidence, name: str) -> list[Check]:
    solution, block = evidence.solution, evidence.fitted_blocks[name]
    camera, places = solution.solved_rig.cameras[name], solution.correspondences.places
    of_place = places.frames_per_place(block.frame_numbers) * evidence.findings.place_variance
    some = block.select_evenly(_MAX_MATCHES)
    seen = some.select(some.errors_px(camera.T_camera_lidar)[1])
    fit = fit_camera(
        camera,
        seen,
        lens_fields_px(camera, seen.block.points_lidar_m),
        loss_scale=solution.scales[name].loss_scale,
        shared_variance=max(of_place, limit("lens_match_share") * len(some)),
    )
    if fit is None:
        return []
    units = units_of(camera)
    freed = _free_each(fit)
    found = (LensParameter.of(n, units[[*numbers]], freed[n]) for n, numbers in _NUMBERS.items())
    checks = [check_parameter(each, RESIDUALS, solution.config.tolerance) for each in found]
    # A focal length that is wrong by one percent is easily overlooked.
    compensating = freed["focal length"].compensating
    moved_m = float(np.linalg.norm(compensating[3:, 0])) / (100 * units[Free.FOCAL])
    row = threshold("focal_sensitivity", solution.config.tolerance)
    return [*checks, row.check(100 * moved_m)]


def _free_each(fit: LinearFit) -> dict[str, Freed]:
    """The fit of each parameter; those of as many numbers together."""
    freed: dict[str, Freed] = {}
    for _, group in groupby(sorted(_NUMBERS, key=_count), _count):
        names = [*group]
        freed |= zip(names, fit.free_each([_NUMBERS[name] for name in names]), strict=True)
    return freed


def _count(name: str) -> int:
    return len(_NUMBERS[name])
