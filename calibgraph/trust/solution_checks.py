"""An estimate by its own numbers: checks of sigmas, relative poses, counts; weak directions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.calibration import Residuals
from calibgraph.model.config import Terms
from calibgraph.model.geometry import camera_center, degrees_and_centimetres
from calibgraph.model.lens import LensEstimate
from calibgraph.model.rig import Camera
from calibgraph.model.verdict import COMMON_ERROR, Check
from calibgraph.solver.error_model import Conflict
from calibgraph.solver.matches import CameraBlock
from calibgraph.solver.robust import quantile
from calibgraph.solver.solution import Solution
from calibgraph.trust.evidence import Evidence, Found
from calibgraph.trust.thresholds import threshold
from factors.columns import CLOCK
from factors.conditioning import invert_or_none

_ROTATIONS = ("about x (pitch)", "about y (yaw)", "about z (roll)")
_SHIFTS = ("along x (right)", "along y (down)", "along z (the optical axis)")
_UNITS = np.repeat([np.radians(0.15), 0.05], 3)  # errors that weigh alike: 0.15 deg, 5 cm
_MENTIONED = 0.4  # of the largest component: smaller ones are left out of the sentence
_THIRDS = ("left", "middle", "right")
_EMPTY, _SPARSE = 0.002, 0.05  # share of the matches in a third of the image
_NEAR_M, _FAR_M = 6.0, 20.0
_SHALLOW = 2.0  # ratio of far to near


def estimate_checks(evidence: Evidence) -> Found:
    """The checks of every camera's estimate."""
    solution, unknown = evidence.solution, evidence.joint_covariance is None
    for name in evidence.cameras:
        block, own = solution.inliers.blocks.get(name), solution.fitted.frame_sums.get(name)
        used, held = 0 if block is None else len(block), name in solution.held
        if held or name not in solution.objective.blocks:
            yield name, _check_unmeasured(used, held=held, excluded=name in evidence.excluded)
            continue
        checks = check_estimate(
            used=used,
            frames=0 if block is None else block.frames,
            covariance=evidence.covariance_by_matches(name),
            is_free=unknown and own is not None and invert_or_none(own.hessian.sum(0)) is None,
            conflicts=[one for one in solution.conflicts if name in (one.pair.a, one.pair.b)],
            converged=solution.optimum.converged,
            terms=solution.terms,
            scatter_only=not evidence.findings.states_common_error,
            tolerance=solution.config.tolerance,
            lens=solution.lens.get(name, ()),
        )
        yield from ((name, check) for check in checks)


def _check_unmeasured(used: int, *, held: bool, excluded: bool) -> Check:
    """The check of a camera without correspondences of its own, or that nothing determines."""
    few = f"{used} usable correspondences, too few"
    kind, why = ("excluded", "excluded by the settings") if excluded else ("", few)
    if held:
        text = f"{why}, and nothing ties it to another camera: it is left at its guess"
        if not excluded:
            text += (
                "; check that its images show something sharp, that the cloud lies where "
                "T_camera_lidar looks, and its name"
            )
        return Check("correspondences", "FAIL", text, used, kind=kind)
    text = (
        f"{why}: determined by other cameras alone, through relative_poses, which have to be "
        "right, or what they see in common"
    )
    return Check("correspondences", "WARN", text, used, kind=kind)


def check_estimate(  # noqa: PLR0913 - what a batch or the tracker knows of one camera
    *,
    used: int,
    frames: int,
    covariance: Array | None,
    is_free: bool,
    conflicts: Sequence[Conflict],
    scatter_only: bool,
    tolerance: tuple[float, float],
    converged: bool = True,
    terms: Terms = "full",
    lens: Sequence[LensEstimate] = (),
) -> Iterator[Check]:
    """The checks of one camera's estimate, from a batch solve or while driving.

    Args:
        used: correspondences in the final solve.
        frames: that they come from.
        covariance: (6, 6) of (rotation [rad], translation [m]), or None.
        is_free: whether its correspondences do not determine it.
        conflicts: of the relative poses that name this camera.
        scatter_only: whether it is unknown how large the error is that all frames share.
        tolerance: of the user: rotation [deg] and distance [cm].
        converged: whether the optimizer did.
        terms: of the objective.
        lens: the parameters of lens and clock that were estimated.
    """
    if covariance is not None:
        degrees, centimetres = degrees_and_centimetres(covariance)
        yield threshold("sigma_rotation", tolerance).check(degrees.max())
        yield threshold("sigma_translation", tolerance).check(centimetres.max())
    if covariance is not None and scatter_only:
        text = (
            "scatter only: the table states no error that its frames share, so that the true error "
            "may be many times the error bar"
        )
        yield Check("common error", "WARN", text, kind=COMMON_ERROR)
    yield from map(_check_relative_pose, conflicts)
    if terms in ("stage1", "priors"):
        text = f"the terms {terms!r} do not fit the correspondences: no error bar"
        yield Check("terms", "WARN", text)
    elif covariance is None and is_free:
        text = "the correspondences leave directions of the pose free"
        yield Check("error bar", "FAIL", text, kind="free")
    elif covariance is None:
        text = "no error bar: the correspondences leave the pose of another camera free"
        yield Check("error bar", "WARN", text, kind="no_error_bar")
    yield threshold("correspondences_used").check(used)
    yield threshold("frames").check(frames)
    yield from map(_check_lens_prior, lens)
    text = f"the optimizer {'converged' if converged else 'did not converge'}"
    yield Check("convergence", "PASS" if converged else "FAIL", text)


def _check_relative_pose(conflict: Conflict) -> Check:
    """Whether a relative pose of the rig agrees with the correspondences."""
    name, sigmas = f"relative pose of {conflict.pair.a} and {conflict.pair.b}", conflict.largest
    degrees = np.degrees(np.linalg.norm(conflict.difference[:3]))
    centimetres = 100 * np.linalg.norm(conflict.difference[3:])
    text = (
        f"the correspondences contradict the measured {name} by "
        f"{degrees:.2g} deg, {centimetres:.2g} cm, {sigmas:.3g} sigma"
    )
    return threshold("relative_pose").check(sigmas, text, name=name)


def _check_lens_prior(one: LensEstimate) -> Check:
    """How far an estimated parameter of lens or clock lies from what the rig states."""
    row = threshold("lens_prior")
    check = row.check(one.prior_sigmas, name=f"{one.name}: {row.name}")
    text = check.text if check.status == "PASS" else f"{check.text} ({one.change})"
    return replace(check, text=text, kind="time_prior" if one.name in CLOCK else row.key)


def flat_evidence_checks(evidence: Evidence) -> Found:
    """Whether the images leave a pose more open than the matches, where images are known."""
    for name in evidence.posteriors:
        wide, narrow = evidence.covariance_of(name), evidence.covariance_by_matches(name)
        if wide is not None and narrow is not None:
            ratio = np.sqrt(np.diag(wide) / np.diag(narrow)).max()
            yield name, threshold("flat_evidence").check(ratio)


def outlier_frame_checks(evidence: Evidence) -> Found:
    """How many frames were left out because they lie far from where most frames agree."""
    for name in evidence.fitted_blocks:
        counts = evidence.solution.counts[name]
        share = counts["outlier_frames"] / max(1, counts["frames"])
        yield name, threshold("outlier_frames").check(share)


def repeated_frame_checks(evidence: Evidence) -> Found:
    """How many frames count as part of another one, where there are any."""
    for name, counts in evidence.solution.counts.items():
        if repeated := counts.get("repeated_frames", 0):
            share = repeated / (repeated + counts["frames"])
            yield name, threshold("repeated_frames").check(share)


def residuals_of(solution: Solution) -> dict[str, Residuals]:
    """Per camera that has correspondences, of all of them, not only the inliers."""
    poses, scales = solution.T_camera_lidar, solution.scales
    blocks = solution.objective.blocks.items()
    return {name: block.summary(poses[name], scales[name]) for name, block in blocks}


def weaknesses(solution: Solution, camera: str, covariance: Array | None) -> tuple[str, ...]:
    """Sentences about weakly observable parameters of one camera, the most important first.

    By the (6, 6) covariance of its pose; if there is none, by that of independent matches.
    """
    block = solution.inliers.blocks.get(camera)
    if block is None or not solution.objective.uses_correspondences:
        return ()
    how = "weakest direction"
    if covariance is None:
        how = "weakest direction, by the matches as if each were independent"
        independent = solution.fitted.frame_sums[camera].hessian.sum(axis=0)
        covariance = invert_or_none(independent)
    direction = [] if covariance is None else [f"{how}: {weakest_direction(covariance)}"]
    T = solution.T_camera_lidar[camera]
    return (*direction, *empty_parts(solution.rig.cameras[camera], block, T))


def weakest_direction(covariance: Array) -> str:
    """The eigenvector of a (6, 6) covariance's largest standard deviation, in words.

    Rotations [rad] and translations [m] are compared relative to their tolerances.
    """
    values, vectors = np.linalg.eigh(covariance / np.outer(_UNITS, _UNITS))
    component = vectors[:, -1] * np.sqrt(values[-1])
    large = np.abs(component) >= _MENTIONED * np.abs(component).max()
    sigmas = np.abs(component * _UNITS)
    turns = [f"turn {_ROTATIONS[i]} {np.degrees(sigmas[i]):.2g} deg" for i in range(3) if large[i]]
    shifts = [f"shift {_SHIFTS[i]} {100 * sigmas[i + 3]:.2g} cm" for i in range(3) if large[i + 3]]
    together = ", together" if len(turns) + len(shifts) > 1 else ""
    return f"{' and '.join(shifts + turns)} (1 sigma{together})"


def empty_parts(camera: Camera, block: CameraBlock, T_camera_lidar: Array) -> list[str]:
    """Sentences about the parts of the image and of depth that have no matches."""
    columns = np.clip(3 * (block.block.pixels_px[:, 0] + 0.5) / camera.width_px, 0, 2.999)
    shares = np.bincount(columns.astype(np.int64), minlength=3) / len(columns)
    words = []
    for third, share in zip(_THIRDS, shares, strict=True):
        if share < _SPARSE:
            few = "no matches" if share < _EMPTY else f"only {share:.1%} of the matches"
            words.append(f"the {third} third of the image has {few}")
    x, y, z = block.block.points_lidar_m.T - camera_center(T_camera_lidar)[:, None]
    distances = np.sqrt(x * x + y * y + z * z)
    near, far = quantile(distances, 0.02), quantile(distances, 0.98)
    if near > _NEAR_M:
        words.append(f"nothing nearer than {near:.2g} m")
    if far < _FAR_M:
        words.append(f"nothing farther than {far:.2g} m")
    if far < _SHALLOW * near:
        words.append("all at about one distance: turn and shift are hard to distinguish")
    return words
