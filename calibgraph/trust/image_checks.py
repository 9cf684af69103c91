"""Checks of a result against the images: wrong optimum, lens, pairing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from calibgraph.errors import CalibrationError
from calibgraph.io.dataset import Dataset
from calibgraph.matching.run import MatchingRun
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Rig
from calibgraph.model.verdict import TOLERANCE, Check
from calibgraph.progress import Progress
from calibgraph.trust.evidence import Checks, grade_by_images
from calibgraph.trust.image_evidence import ImageEvidence, measure_image_evidence
from calibgraph.trust.lens_parameter import IMAGES, check_parameter
from calibgraph.trust.thresholds import limit, threshold


def image_checks(run: MatchingRun) -> Checks:
    """Whether the images agree with a result; nothing if there is no time left for them.

    They are scored as by the matcher ``structure``, which does not use all that other matchers use:
    the result of a matcher that does not fail on images gets warnings only. Of a solution with
    camera pairs, the one without them is checked: next to a camera with a wrong lens, a right one
    is moved, and at the wrong one's place the lens cannot be measured.
    """
    if run.out_of_time:
        return {}
    rig, config = run.solution.without_pairs().solved_rig, run.solution.config
    try:
        checks = check_images(
            run.dataset, rig, run.correspondences,
            tolerance=config.tolerance, seed=config.seed, progress=run.progress,
        )  # fmt: skip
    except (CalibrationError, OSError) as error:  # files that its matcher did not need
        text = f"the images could not be checked: {error}"
        return {name: [Check("image evidence", "WARN", text)] for name in rig.cameras}
    return grade_by_images(run, checks)


def check_images(
    dataset: Dataset,
    rig: Rig,
    table: Correspondences,
    *,
    tolerance: tuple[float, float] = TOLERANCE,
    seed: int = 0,
    progress: Progress | None = None,
) -> dict[str, tuple[Check, ...]]:
    """Score images and clouds at the extrinsics of a result, and displaced from them.

    Not observable: a principal point wrong along the shorter side of the image (it is equivalent to
    a rotation).

    Returns:
        Checks of every camera but those that a search did not find: theirs is no pose to check.
    """
    missed = table.findings.missed
    cameras = {name: camera for name, camera in rig.cameras.items() if name not in missed}
    if not cameras:
        return {}
    evidence = measure_image_evidence(
        dataset, Rig(cameras=cameras), places=table.places, seed=seed, progress=progress
    )
    if table.is_swept:
        evidence = {name: replace(found, lens=()) for name, found in evidence.items()}
    names = {frame.index: frame.name for frame in dataset.frames}
    return {
        name: (*evidence_checks(found, names, tolerance), *pairing_checks(found))
        for name, found in evidence.items()
    }


def evidence_checks(
    found: ImageEvidence, names: Mapping[int, str], tolerance: tuple[float, float] = TOLERANCE
) -> tuple[Check, ...]:
    """The checks of one camera's extrinsic and lens by the image evidence."""
    if math.isnan(found.displaced_z_score):
        text = (
            f"the images could not be checked: only {found.groups} places with structure in both "
            "image and cloud"
        )
        return (Check("image evidence", "WARN", text, found.groups),)
    displaced = threshold("displaced_z_score").check(found.displaced_z_score)
    of_pose = displaced, frames_check(found, names)
    mispaired = found.frames_best <= limit("lens_frames_best")
    if found.displaced_z_score < limit("lens_z_score") or mispaired:
        return of_pose  # at a wrong extrinsic the lens cannot be measured
    return *of_pose, *(check_parameter(each, IMAGES, tolerance) for each in found.lens)


def frames_check(found: ImageEvidence, names: Mapping[int, str]) -> Check:
    """Whether the frames of a camera fit one extrinsic: something may have moved meanwhile.

    A solve leaves such frames out, and the rest agrees.
    """
    row, lost = threshold("frames_best"), ", ".join(names[n] for n in found.frames_lost[:5])
    return row.check(found.frames_best, advice=f"{lost} fit another extrinsic better: {row.advice}")


def pairing_checks(found: ImageEvidence) -> tuple[Check, ...]:
    """Whether images and clouds belong together; nothing without neighbouring frames."""
    if math.isnan(found.pair_margin):
        return ()
    side = "next" if found.pair_offset > 0 else "previous"
    advice = (
        f"the images fit the clouds of the {side} frame better; check which image belongs to "
        "which cloud, and their time stamps"
    )
    return (threshold("own_clouds").check(found.pair_margin, advice=advice),)
