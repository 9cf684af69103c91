"""Whether parts agree: cameras by their images, left-out matches, and places with each other."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import combinations

import numpy as np

from calibgraph.arrays import Array
from calibgraph.graph.latent_poses import place_of
from calibgraph.model.findings import error_components
from calibgraph.model.geometry import (
    pose_difference,
    relative_covariance,
    relative_transform,
    twist_between,
)
from calibgraph.model.rig import Rig
from calibgraph.model.verdict import TOLERANCE, Check
from calibgraph.solver.matches import camera_block
from calibgraph.solver.pair_refinement import PairFit
from calibgraph.solver.pnp import RANSAC_ITERATIONS, frame_pose
from calibgraph.solver.solution import Solution
from calibgraph.trust.evidence import Evidence, Found
from calibgraph.trust.thresholds import threshold

ONE_POSE_DEG, ONE_POSE_CM = 0.1, 1.0
"""Housings do not fit closer; two results of one device's images end as near."""

BLAME_SIGMAS = 1.0
"""Factor by which one camera of a pair must disagree more with its other neighbours than the other
one with its own, to be taken for the one that is wrong."""


Apart = tuple[float, float, float]
"""Degrees and centimetres between two T_b_a; the largest difference along an axis in sigmas."""


def pair_agreement_checks(evidence: Evidence) -> Found:
    """Whether the correspondences place the cameras relative to each other as the images do."""
    solution, alone = evidence.solution, evidence.solution.without_pairs()
    if solution.camera_matches is None or solution.alone is None or alone.mount is None:
        return
    rig, covariance = solution.rig.moved_to(alone.mount.T_camera_lidar), alone.mount.covariance
    apart = {
        (fit.a, fit.b): pair_agreement(rig, fit, covariance)
        for fit in alone.pair_fits
        if evidence.fitted_blocks.keys() >= {fit.a, fit.b}
    }
    for pair in apart:
        yield from ((name, check_agreement(pair, name, apart)) for name in pair)


def check_agreement(
    pair: tuple[str, str], camera: str, apart: Mapping[tuple[str, str], Apart]
) -> Check:
    """The check of one camera of a pair, which other pairs may show to be the other's fault."""
    row, (degrees, centimetres, sigmas) = threshold("pair_agreement"), apart[pair]
    (other,), name = {*pair} - {camera}, f"relative pose of {pair[0]} and {pair[1]} by images"
    text = (
        f"images and correspondences contradict each other on the pose of {pair[0]} to {pair[1]} "
        f"by {degrees:.2g} deg, {centimetres:.2g} cm, {sigmas:.3g} sigma"
    )
    own, of_other = (  # by which each disagrees with the cameras outside the pair
        max((of[2] for names, of in apart.items() if names != pair and one in names), default=0.0)
        for one in (camera, other)
    )
    if row.grade(sigmas) == "PASS" or not of_other > max(row.warn, own + BLAME_SIGMAS):
        return row.check(sigmas, text, name=name)
    advice = f"by its other pairs ({of_other:.3g} sigma) it is {other} that is wrong"
    return row.check(own, text, name=name, advice=advice, status="WARN")


def pair_agreement(rig: Rig, fit: PairFit, covariance: Array) -> Apart:
    """A pair by its images, A held near the calibration, against one that has not used them.

    Args:
        rig: mounts at the calibration.
        fit: of the pair.
        covariance: (6 N, 6 N) of the calibration, in the rig's order.
    """
    first, second = (tuple(rig.cameras).index(name) for name in (fit.a, fit.b))
    T_b_a = relative_transform(rig.T_camera_lidar[fit.b], rig.T_camera_lidar[fit.a])
    own = relative_covariance(covariance, first, second, T_b_a)
    sigmas = np.sqrt(np.diag(own) + np.diag(fit.covariance))
    largest = float(np.max(np.abs(twist_between(fit.T_b_a, T_b_a)) / sigmas))
    return *pose_difference(fit.T_b_a, T_b_a), largest


def one_pose_checks(evidence: Evidence) -> Found:
    """Cameras that end at one pose, unless the rig ties them there: have they one device's images?

    Nothing else in a result shows it: images have the pose of the device that took them.
    """
    rig, T = evidence.solution.rig, evidence.solution.T_camera_lidar
    tied = {frozenset((one.a, one.b)) for one in rig.relative_poses if _is_one_pose(one.T_a_b)}
    for a, b in combinations(T, 2):
        if not _is_one_pose(relative_transform(T[a], T[b])) or {a, b} in tied:
            continue
        degrees, centimetres = pose_difference(T[a], T[b])
        text = (
            f"{a} and {b} end {degrees:.2g} deg, {centimetres:.2g} cm from each other: have they "
            "the images of one device? If they are mounted so, state it in relative_poses"
        )
        check = Check("cameras at one pose", "WARN", text, kind="one_pose")
        yield from ((a, check), (b, check))


def _is_one_pose(T_a_b: Array) -> bool:
    degrees, centimetres = pose_difference(T_a_b, np.eye(4))
    return degrees <= ONE_POSE_DEG and centimetres <= ONE_POSE_CM


_FEWEST_ITERATIONS = 50  # of MAGSAC, which also polishes its result
_MISSED = 1e-6  # probability that no sample of a competing solution large enough to count is clean


def competing_solution_checks(evidence: Evidence) -> Found:
    """Whether the matches that a solution leaves out agree on another extrinsic."""
    for name in evidence.fitted_blocks:
        yield name, check_competing_solution(evidence.solution.without_pairs(), name)


def check_competing_solution(solution: Solution, camera: str) -> Check:
    """Ratio of the matches that agree on another extrinsic alone to those on this one alone."""
    row, tolerance = threshold("competing_solution"), solution.config.tolerance
    block, gate_px = solution.objective.blocks[camera], solution.scales[camera].gate_px
    if solution.counts[camera]["outlier_frames"]:  # which may agree on another pose
        rows = solution.correspondences.of_camera(camera)
        block = camera_block(solution.rig.cameras[camera], rows, solution.config)
    ours = block.within_gate(solution.T_camera_lidar[camera], gate_px)
    left_out = block.block.select(~ours)
    T, seen_by = None, solution.rig.cameras[camera]
    if len(left_out):
        iterations = _ransac_iterations(row.warn * int(ours.sum()), len(left_out))
        T = frame_pose(seen_by, left_out, solution.config, iterations=iterations)
    if T is None:
        return row.check(0.0, f"{row.name}: none")
    theirs = block.within_gate(T, gate_px)
    degrees, centimetres = pose_difference(T, solution.T_camera_lidar[camera])
    apart = zip((degrees, centimetres), tolerance, TOLERANCE, strict=True)
    same = all(far < max(stated, usual) for far, stated, usual in apart)
    only_theirs, only_ours = int((theirs & ~ours).sum()), int((ours & ~theirs).sum())
    share = 0.0 if same else only_theirs / max(only_ours, 1)
    advice = f"the other is {degrees:.2g} deg, {centimetres:.2g} cm away; which one is right?"
    return row.check(share, advice=advice)


def _ransac_iterations(fewest: float, matches: int) -> int:
    """Samples of 4 matches that find a competing solution if it is large enough for a warning."""
    share = min(fewest / 2 / matches, 0.99)
    needed = math.log(_MISSED) / math.log1p(-(share**4)) if share > 0 else math.inf
    return int(min(max(needed, _FEWEST_ITERATIONS), RANSAC_ITERATIONS))


def place_checks(evidence: Evidence) -> Found:
    """Whether any place contradicts the others, where there are enough to tell which.

    Of the place that agrees least, by its distance: that of the camera or of the cloud there from
    where they are elsewhere; and by its inliers: the share of the matches within the gate over its
    median at the other places.
    """
    errors = evidence.solution.error_fit
    if errors is None or len(errors.model.frames) < error_components().robust_places:
        return
    cameras, of_place = tuple(errors.model.cameras), errors.linear.distances
    frames = errors.model.frames
    for name in errors.model.blocks:
        kept, given = (
            np.bincount(place_of(b.frame_numbers, frames), b.frame_counts, len(of_place))
            for b in (evidence.solution.inliers.blocks[name], evidence.fitted_blocks[name])
        )
        seen = np.flatnonzero(given)
        if len(seen) < 2:  # noqa: PLR2004
            continue
        shares = kept[seen] / given[seen]
        others = [max(np.median(np.delete(shares, at)), 1e-9) for at in range(len(seen))]
        distances = of_place[seen][:, [0, 1 + cameras.index(name)]].max(axis=1)
        worst = (
            ("place_distance", distances, int(np.argmax(distances))),
            ("place_inliers", shares / others, int(np.argmin(shares / others))),
        )
        for key, values, at in worst:
            row, value, place = threshold(key), float(values[at]), int(seen[at])
            first, last = int(frames[place][0]), int(frames[place][-1])
            which = f"frame {first}" if first == last else f"frames {first} to {last}"
            number = f"{value:.2g} {row.unit}".rstrip()
            yield name, row.check(value, f"{row.name}: {number} at place {place + 1} ({which})")
