"""Checks of the initial guess: convention errors, another frame, swapped cameras, units."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.model.geometry import invert, pose_difference, transform
from calibgraph.trust.conventions import convention_error_between, difference, in_words
from calibgraph.trust.evidence import Evidence, Found
from calibgraph.trust.thresholds import GUESS_TURNED_DEG, SWAP_SLACK, threshold


def guess_checks(evidence: Evidence) -> Found:
    """Whether a result is so far from its guess that the guess follows another convention.

    A result may lie as far away as its matcher searches. One that is turned farther counts where a
    convention error of the guess explains it.
    """
    findings, row = evidence.findings, threshold("guess_translation")
    range_deg, range_m = (
        math.sqrt(3) * (reach or 0.0)
        for reach in (findings.range_rotation_deg, findings.range_translation_m)
    )
    row, guesses = replace(row, warn=max(row.warn, range_m)), evidence.guess.T_camera_lidar
    frame = describe_other_frame(guesses, evidence.found)
    for name, result in evidence.solution.T_camera_lidar.items():
        degrees, metres = difference(guesses[name], result)
        is_far = degrees > max(GUESS_TURNED_DEG, range_deg) or row.grade(metres) != "PASS"
        error = convention_error_between({"": guesses[name]}, {"": result}) if is_far else None
        words = "" if error is None else f"it seems that {in_words(error)}"
        check = row.check(metres, advice="; or ".join(filter(None, (words, frame))))
        if words and check.status == "PASS":
            text = f"{check.text} and {degrees:.3g} deg: {words}"
            check = replace(check, status="WARN", text=text)
        yield name, check


def swap_checks(evidence: Evidence) -> Found:
    """Whether a camera ended where another one's guess is; of those that have been found."""
    return compare_with_other_guesses(evidence.guess.T_camera_lidar, evidence.found)


def compare_with_other_guesses(guesses: Mapping[str, Array], results: Mapping[str, Array]) -> Found:
    """The distance of two cameras to each other's guess over that to their own, at the least.

    With Gaussian errors of the guesses, of unknown size, the likelihood ratio of a swap is the
    12th power of own over other: there are six numbers a camera. If the other camera has no result,
    it is the 6th, so that the square root of the distances' ratio stands for as much.

    A check per result, by (4, 4) T_camera_lidar; none for a single camera.
    """
    names, row = [*guesses], threshold("swapped_cameras")
    if len(names) == 1 or not results:
        return
    squared = np.full((len(names), len(names)), np.nan)  # from a guess to a result, if there is one
    found = [name in results for name in names]
    ended = np.array([results[name] for name in names if name in results])
    away = ended @ invert(np.array([*guesses.values()]))[:, None]
    shifts, turns = away[..., :3, 3], away[..., :3, :3].reshape(-1, 3, 3)
    angles = Rotation.from_matrix(turns).magnitude().reshape(away.shape[:2])
    squared[:, found] = angles**2 + (shifts**2).sum(axis=-1) + SWAP_SLACK**2
    own = np.diag(squared)
    ratios = np.sqrt((squared + squared.T) / (own + own[:, None]))
    ratios = np.where(np.isnan(own)[:, None], (squared / own) ** 0.25, ratios)
    np.fill_diagonal(ratios, np.inf)
    for name in results:
        of = ratios[:, names.index(name)]
        other = names[int(of.argmin())]
        what = f"distance of this camera and {other} to each other's guess over that to their own"
        yield name, row.check(float(of.min()), name=what)


_SOME_POINTS = 1000  # know a median distance to some percent; one in other units is off by 10


def point_distance_checks(evidence: Evidence) -> Found:
    """Whether the points can be in metres."""
    row = threshold("point_distance")
    for name, block in evidence.solution.objective.blocks.items():
        x, y, z = block.block.points_lidar_m[:: -(-len(block) // _SOME_POINTS)].T
        yield name, row.check(float(np.median(np.sqrt(x * x + y * y + z * z))))


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
