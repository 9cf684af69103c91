"""Checks of the initial guess: convention errors, swapped cameras, units, the matcher's range."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.matching.run import MatchingRun
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.geometry import (
    angle_deg,
    invert,
    pose_difference,
    relative_transform,
    transform,
)
from calibgraph.model.verdict import Check
from calibgraph.trust.conventions import convention_error_between, in_words
from calibgraph.trust.evidence import Checks, Evidence
from calibgraph.trust.thresholds import limit, threshold


def guess_checks(evidence: Evidence) -> Checks:
    """Whether a result is so far from its guess that the guess follows another convention."""
    return {
        name: compare_with_guess(evidence.guess.T_camera_lidar[name], T, evidence.findings)
        for name, T in evidence.solution.T_camera_lidar.items()
    }


def compare_with_guess(guess: Array, result: Array, findings: MatcherFindings) -> list[Check]:
    """The distance of one camera's result from its guess, both (4, 4), and the guess's length.

    A result may lie as far away as its matcher searches. One that is turned farther counts where a
    convention error of the guess explains it.
    """
    range_deg = math.sqrt(3) * (findings.range_rotation_deg or 0.0)
    range_m = math.sqrt(3) * (findings.range_translation_m or 0.0)
    degrees = angle_deg(guess[:3, :3] @ result[:3, :3].T)
    metres = float(np.linalg.norm(guess[:3, 3] - result[:3, 3]))
    row = threshold("guess_translation")
    row = replace(row, warn=max(row.warn, range_m))
    is_turned = degrees > max(limit("guess_rotation"), range_deg)
    is_far = is_turned or row.grade(metres) != "PASS"
    error = convention_error_between({"": guess}, {"": result}) if is_far else None
    advice = "" if error is None else f"it seems that {in_words(error)}"
    check = row.check(metres, advice=advice)
    if error is not None and check.status == "PASS":
        text = f"{check.text} and {degrees:.3g} deg: {advice}"
        check = replace(check, status="WARN", text=text)
    return [check, threshold("guess_length").check(float(np.linalg.norm(guess[:3, 3])))]


def swap_checks(evidence: Evidence) -> Checks:
    """Whether a camera ended where another one's guess is; of those that have been found."""
    guesses, missed = evidence.guess.T_camera_lidar, evidence.findings.missed
    results = {n: T for n, T in evidence.solution.T_camera_lidar.items() if n not in missed}
    return {name: compare_with_other_guesses(name, guesses, results) for name in results}


def compare_with_other_guesses(
    camera: str, guesses: Mapping[str, Array], results: Mapping[str, Array]
) -> list[Check]:
    """The distance of two cameras to each other's guess over that to their own, at the least.

    With Gaussian errors of the guesses, of unknown size, the likelihood ratio of a swap is the
    12th power of own over other: there are six numbers a camera. If the other camera has no result,
    it is the 6th, so that the square root of the distances' ratio stands for as much.

    One check, by (4, 4) T_camera_lidar of guesses and results; none for a single camera.
    """
    others = [name for name in guesses if name != camera]
    if not others:
        return []
    pairs_of = product(guesses, results)
    squared = dict(zip(pairs_of, _squared_distances(guesses, results).flat, strict=True))

    def ratio(other: str) -> float:
        swapped = {camera: other, other: camera}
        pairs = [(swapped[name], name) for name in swapped if name in results]
        own = sum(squared[name, name] for _, name in pairs)
        return float((sum(squared[pair] for pair in pairs) / own) ** (len(pairs) / 4))

    other = min(others, key=ratio)
    name = f"distance of this camera and {other} to each other's guess over that to their own"
    return [threshold("swapped_cameras").check(ratio(other), name=name)]


def _squared_distances(guesses: Mapping[str, Array], results: Mapping[str, Array]) -> Array:
    """(g, r) between T_camera_lidar: centres [m] and angle [rad], and a result's usual error."""
    one, two = (np.array([*each.values()])[:, None] for each in (guesses, results))
    R = one[..., :3, :3] @ two[:, 0, :3, :3].swapaxes(1, 2)
    axes = R[..., [2, 0, 1], [1, 2, 0]] - R[..., [1, 2, 0], [2, 0, 1]]
    angles = np.arctan2(np.linalg.norm(axes, axis=-1), np.trace(R, axis1=-2, axis2=-1) - 1.0)
    centers = [T[..., :3, :3].swapaxes(-1, -2) @ T[..., :3, 3:] for T in (one, two)]
    apart = centers[0] - centers[1][:, 0]
    return np.asarray(angles**2 + (apart**2).sum(axis=(-1, -2)) + limit("swap_slack") ** 2)


def point_distance_checks(evidence: Evidence) -> Checks:
    """Whether the points can be in metres."""
    checks, row = {}, threshold("point_distance")
    for name, block in evidence.solution.objective.blocks.items():
        x, y, z = block.block.points_lidar_m.T  # which need not be contiguous
        checks[name] = [row.check(float(np.median(np.sqrt(x * x + y * y + z * z))))]
    return checks


_FRAME_M, _ALIKE_DEG, _ALIKE_CM = 1.0, 5.0, 50.0
"""From how far on a motion of all cameras is that of a frame, and how alike it is, of rough guesses
(the sample's are 2 deg and 20 cm off)."""


def describe_other_frame(guess: Mapping[str, Array], results: Mapping[str, Array]) -> str:
    """The frame of the guesses, where all cameras are moved alike; empty if they are not.

    A single camera is if it is moved without a turn. By (4, 4) T_camera_lidar.
    """
    T_frame_lidar = [invert(guess[name]) @ T for name, T in results.items()]
    if not T_frame_lidar:
        return ""
    first = T_frame_lidar[0]
    others = T_frame_lidar[1:] or [transform(np.eye(3), first[:3, 3])]
    apart = [pose_difference(first, T) for T in others]
    if np.linalg.norm(first[:3, 3]) < _FRAME_M or not all(
        degrees < _ALIKE_DEG and centimetres < _ALIKE_CM for degrees, centimetres in apart
    ):
        return ""
    x, y, z = first[:3, 3]
    moved = "the camera is" if len(results) == 1 else "all cameras are"
    return (
        f"{moved} moved as if the guess were of another frame of the vehicle, as base_link, in "
        f"which the LiDAR is at x {x:.2f}, y {y:.2f}, z {z:.2f} m: multiply its T_camera_lidar by "
        "this pose from the right"
    )


def range_checks(run: MatchingRun) -> Checks:
    """Whether a result lies within the matcher's range around the guess."""
    findings, guess = run.correspondences.findings, run.guess.T_camera_lidar
    results = run.solution.T_camera_lidar
    found = {name: T for name, T in results.items() if name not in findings.missed}
    frame = describe_other_frame(guess, found)
    return {
        name: compare_with_range(guess[name], T, findings, frame) for name, T in results.items()
    }


def compare_with_range(
    guess: Array, result: Array, findings: MatcherFindings, frame: str = ""
) -> list[Check]:
    """The largest component of the step from a guess to its result, over the matcher's range.

    By (4, 4) T_camera_lidar. Without the range there are no checks.
    """
    step = relative_transform(result, guess)
    rotation_deg = np.degrees(Rotation.from_matrix(step[:3, :3]).as_rotvec())
    components = (
        (threshold("range_rotation"), rotation_deg, findings.range_rotation_deg),
        (threshold("range_translation"), step[:3, 3], findings.range_translation_m),
    )
    return [
        row.check(float(np.abs(three).max() / max(largest, 1e-9)), advice=frame)
        for row, three, largest in components
        if largest is not None
    ]
