"""Checks of the rounds of matching: convergence, repeated clouds, the displaced start, time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from calibgraph.io.dataset import Dataset
from calibgraph.matching.run import Rematch
from calibgraph.model.geometry import pose_difference
from calibgraph.model.verdict import TOLERANCE, WENT_ON, Check
from calibgraph.trust.evidence import Checks
from calibgraph.trust.inputs import describe_copies, describe_repeats
from calibgraph.trust.run_evidence import RunEvidence
from calibgraph.trust.thresholds import threshold

REMATCH_DEG, REMATCH_M = 0.5, 0.08
"""How far the start of matching again is displaced from the result."""


def last_round_checks(evidence: RunEvidence) -> Checks:
    """How far the last of several rounds of matching still moved the cameras."""
    rounds = evidence.run.rounds
    if len(rounds) == 1:
        return {}
    tolerance = evidence.run.solution.config.tolerance
    return {
        name: [
            threshold("last_round_rotation", tolerance).check(moved["moved_deg"]),
            threshold("last_round_translation", tolerance).check(moved["moved_cm"]),
        ]
        for name, moved in rounds[-1].items()
    }


def repeated_file_checks(evidence: RunEvidence) -> Checks:
    """Which frames were copies, and whether others have the same cloud or image of a camera."""
    run, cameras = evidence.run, evidence.solution.cameras
    checks = check_repeated_files(run.dataset, evidence.hashes, cameras)
    if run.copies:
        check = Check("copies", "WARN", describe_copies(run.copies), len(run.copies))
        checks = {name: [check, *each] for name, each in checks.items()}
    return checks


def check_repeated_files(
    dataset: Dataset, hashes: Mapping[str, str], cameras: Sequence[str]
) -> dict[str, list[Check]]:
    """Per camera, a check of the first kind of file that frames have in common, if any."""
    frames = [(f.name, f.image_paths, hashes[str(f.cloud_path)]) for f in dataset.frames]
    of_clouds = describe_repeats("cloud", [(name, digest) for name, _, digest in frames])
    checks: dict[str, list[Check]] = {}
    for camera in cameras:
        images = [(n, hashes[str(paths[camera])]) for n, paths, _ in frames if camera in paths]
        text = describe_repeats(f"image of {camera}", images) or of_clouds
        checks[camera] = [Check("equal files", "WARN", text)] if text else []
    return checks


def rematch_checks(evidence: RunEvidence) -> Checks:
    """Whether matching again from a displaced start ended at the same result."""
    return compare_ends(evidence.run.rematch, evidence.run.solution.config.tolerance)


def compare_ends(rematch: Rematch | None, tolerance: tuple[float, float] = TOLERANCE) -> Checks:
    """Per camera, the difference between the two ends; nothing if there is only one.

    Args:
        rematch: both ends.
        tolerance: of the user [deg, cm].
    """
    if rematch is None:
        return {}
    start = f"matching again from a start {REMATCH_DEG:g} deg, {100 * REMATCH_M:g} cm off"
    if rematch.again is None:
        check = Check("matching again", "FAIL", f"{start} failed: {rematch.failure}")
        return {name: [check] for name in rematch.first.cameras}
    again, checks = rematch.again.T_camera_lidar, {}
    for name, T in rematch.first.T_camera_lidar.items():
        degrees, centimetres = pose_difference(T, again[name])
        words = f"{start}: difference"
        checks[name] = [
            threshold("rematch_rotation", tolerance).check(degrees, name=words),
            threshold("rematch_translation", tolerance).check(centimetres, name=words),
        ]
    return checks


def going_on_checks(evidence: RunEvidence) -> Checks:
    """Which rounds ended elsewhere than the images allow, and went on from there."""
    text = (
        "rounds of matching ended {:.2g} deg, {:.2g} cm away, where the images agree less, and "
        "went on from where they agree better: this scene misleads coarse levels"
    )
    return {
        name: [Check("rounds that went on", "WARN", text.format(*moved), moved[0], kind=WENT_ON)]
        for name, moved in evidence.run.went_on.items()
    }


def time_limit_checks(evidence: RunEvidence) -> Checks:
    """Whether the time limit left something out."""
    run = evidence.run
    if not run.out_of_time:
        return {}
    missed = f"{run.missed_rounds} rounds of matching and " if run.missed_rounds else ""
    text = f"partial: there was no time for {missed}the checks against the images"
    check = Check("time limit", "WARN", text, run.missed_rounds)
    return {name: [check] for name in evidence.solution.cameras}
