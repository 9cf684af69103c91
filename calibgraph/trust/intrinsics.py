"""A wrong lens or clock leaves a pattern in the residuals: the posterior of both, by matches."""

from __future__ import annotations

import numpy as np

from calibgraph.model.rig import Camera
from calibgraph.model.verdict import Check
from calibgraph.parallel import map_on_cores
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.linear_fit import fit_camera
from calibgraph.trust.evidence import Checks, Evidence
from calibgraph.trust.lens_checks import RESIDUALS, check_lens
from calibgraph.trust.lens_posterior import Free, LensPosterior, fields_px, free_of
from calibgraph.trust.thresholds import limit, threshold
from factors.free_lens import CLOCK

MIN_FRAMES = 4  # with fewer, a single frame decides about the time
_MAX_MATCHES = 20_000  # evenly chosen: bounds the time


def intrinsics_checks(evidence: Evidence) -> Checks:
    """Whether a wrong lens or clock explains the residuals, and how much hangs on the focal length.

    By all matches, not only those within the gate; the clock where the motion of the LiDAR is known
    and the clock is not estimated.
    """
    evidence = evidence.of_correspondences
    names = [*evidence.fitted_blocks]
    checks = map_on_cores(lambda name: _check_camera(evidence, name), names)
    return dict(zip(names, checks, strict=True))


def _check_camera(evidence: Evidence, name: str) -> list[Check]:
    solution, block = evidence.solution, evidence.fitted_blocks[name]
    camera, config = solution.solved_rig.cameras[name], solution.config
    some = block.select_evenly(_MAX_MATCHES)
    seen = some.select(some.errors_px(camera.T_camera_lidar)[1])
    of_place = solution.correspondences.places.frames_per_place(block.frame_numbers)
    found = fit_lens(
        camera,
        seen,
        loss_scale=solution.scales[name].loss_scale,
        place_variance=of_place * evidence.findings.place_variance,
        is_timed={*CLOCK}.isdisjoint(config.estimate),
    )
    if found is None:
        return []
    checks = check_lens(found, RESIDUALS, config.tolerance, config.estimate)
    if Free.FOCAL not in found.free:
        return checks
    # A focal length that is wrong by one percent is easily overlooked.
    by_share_m = np.linalg.norm(found.compensating[3:, 0]) / found.units[0]
    row = threshold("focal_sensitivity", config.tolerance)
    return [*checks, row.check(float(by_share_m))]


def fit_lens(
    camera: Camera,
    block: CameraBlock,
    *,
    loss_scale: float | None = None,
    place_variance: float = 0.0,
    is_timed: bool = True,
) -> LensPosterior | None:
    """The posterior of a camera's lens, and of its clock where its matches have the motion.

    Args:
        camera: at the result.
        block: its matches, their points at the times of the pixels.
        loss_scale: of the whitened errors; None: from their median.
        place_variance: of what the matches of a place share, over that of all matches if these were
            independent. It is at least that of a small share of each match.
        is_timed: whether the offset is among the unknowns.

    Returns:
        The posterior, or None of too few matches, or of a panorama without a clock.
    """
    motion = block.block.motion if is_timed and block.frames >= MIN_FRAMES else None
    free = free_of(camera, is_timed=motion is not None)
    if not free:
        return None
    twist = None if motion is None else motion[:, :6]
    fit = fit_camera(
        camera,
        block,
        fields_px(camera, free, block.block.points_lidar_m, twist),
        loss_scale=loss_scale,
        shared_variance=max(place_variance, limit("lens_match_share") * len(block)),
    )
    return None if fit is None else LensPosterior.of(camera, free, fit)
