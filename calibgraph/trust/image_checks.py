"""Checks of a result against the images: wrong optimum, lens, pairing, time offset."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from calibgraph.io.dataset import Dataset
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Rig
from calibgraph.model.verdict import Check, above, below, grade
from calibgraph.progress import Progress
from calibgraph.trust.image_evidence import ImageEvidence, measure_image_evidence
from calibgraph.trust.time_offset import TimeOffset, time_offsets

FOCAL_WARN, FOCAL_FAIL = 0.008, 0.025
"""Relative error of the focal length. On sequence 00 and the sample: up to 0.5 % where it is right,
1.1 % and more where it is wrong by 2 to 5 %. One percent displaces a result by about 10 cm."""

RADIAL_WARN, RADIAL_FAIL = 0.03, 0.1
"""Error of the first radial coefficient. On sequence 00 and the sample: up to 0.02 where it is
right; 0.08 and more where it is wrong by 0.1, which displaces a result by about 15 cm."""

CENTRE_WARN, CENTRE_FAIL = 0.018, 0.035
"""Error of the principal point in focal lengths: radians that it turns a result by. On sequence 00
and the sample: up to 0.013 where it is right, 0.026 and 0.04 where it is wrong by 20 px."""

MAX_LENS_SIGMA = 0.5  # of the threshold: above, the images do not tell

DISPLACED_WARN, DISPLACED_FAIL = 4.0, 2.5
"""On sequences 00 and 01 and the sample: right results 4.9 and more, wrong ones from a start too
far away up to 3.8, mostly below 2.5. Mispaired images reach 5.1: see FRAMES_BEST. A 16-beam LiDAR
at one place had 2.9 at 0.4 deg."""

LENS_CONTRAST = 3.0
"""Below, the lens is not asked about: a wrong pose says nothing of it. On sequence 00 and the
sample wrong lenses left 3.2 and more."""

FRAMES_BEST_WARN, FRAMES_BEST_FAIL = 0.8, 0.5
"""On sequence 00 and the sample: right results 100 %, mispaired images up to 67 %, mostly 50 %."""

GAIN_WARN, GAIN_FAIL = 1.0, 3.0
"""On sequence 00 and the sample: right results up to 0.65; one 0.35 deg off 1.0; local optima next
to the right one 11 to 32."""

PAIR_WARN, PAIR_FAIL = -0.05, -0.2
"""On sequence 00: own clouds +0.4 and more, clouds that are one frame off -0.4 and less. Where the
vehicle stands it is about zero, which is no fault."""

OFFSET_WARN, OFFSET_FAIL, OFFSET_SIGMAS = 0.1, 0.3, 3.0
"""Of a frame interval: at 10 Hz and 10 m/s, 10 cm and 30 cm. Counted from so many sigmas off."""


def image_checks(
    dataset: Dataset,
    rig: Rig,
    table: Correspondences,
    *,
    seed: int = 0,
    progress: Progress | None = None,
) -> dict[str, tuple[Check, ...]]:
    """Look at images and clouds once more from the poses of a result.

    Not found: a principal point wrong along the shorter side of the image (it is no different from
    a rotation), and a time offset under an even motion (no different from a translation).

    Args:
        dataset: images and clouds; neighbouring frames of a folder are neighbours in time.
        rig: the result.
        table: the correspondences of its last round.
        seed: of the searches.
        progress: to be told how far it is.

    Returns:
        Checks of every camera.
    """
    evidence = measure_image_evidence(dataset, rig, seed=seed, progress=progress)
    offsets = time_offsets(dataset, rig, table)
    of_time = {
        name: (*pairing_checks(found), *offset_checks(offsets.get(name)))
        for name, found in evidence.items()
    }
    return {
        name: (*evidence_checks(found), *of_time[name], *_clouds_checks(name, of_time))
        for name, found in evidence.items()
    }


def _clouds_checks(camera: str, of_time: Mapping[str, Sequence[Check]]) -> list[Check]:
    """What other cameras say of the clouds, which are all cameras' clouds."""
    if any(check.status != "PASS" for check in of_time[camera]):
        return []  # it says so itself
    return [
        Check("clouds of another time", "WARN", f"as {other} sees it, {check.text}")
        for other, checks in of_time.items()
        for check in checks
        if check.status != "PASS"
    ]


def evidence_checks(found: ImageEvidence) -> tuple[Check, ...]:
    """Judge what the images say of one camera's result."""
    if math.isnan(found.displaced_z_score):
        text = (
            f"the images could not be asked about the result: only {found.groups} places with "
            "structure in both image and cloud"
        )
        return (Check("image evidence", "WARN", text, found.groups),)
    checks = [
        below(
            "contrast to displaced poses", found.displaced_z_score, DISPLACED_WARN, DISPLACED_FAIL,
            "standard deviations",
            "poses a degree or 40 cm away explain the images nearly as well; check the guess, "
            "or record where there is more structure",
        ),
        _frames_check(found),
    ]  # fmt: skip
    if found.displaced_z_score >= LENS_CONTRAST and found.frames_best > FRAMES_BEST_FAIL:
        # a wrong pose, or images of other clouds, say nothing of the lens
        lens = _lens_checks(found)
        checks += [*lens, *_gain_check(found, lens)]
    return tuple(checks)


def _frames_check(found: ImageEvidence) -> Check:
    lost = ", ".join(map(str, found.frames_lost[:5])) + (", ..." if found.frames_lost[5:] else "")
    return below(
        "frames whose image fits the pose best", found.frames_best,
        FRAMES_BEST_WARN, FRAMES_BEST_FAIL, "share",
        f"frames {lost} prefer displaced poses; do their images and clouds belong together?",
    )  # fmt: skip


def _lens_checks(found: ImageEvidence) -> tuple[Check, ...]:
    """Whether another lens fits the images better."""
    log_focal, radial, centre = found.lens
    focal = math.expm1(log_focal)
    longer = "longer" if focal > 0 else "shorter"
    return tuple(
        _lens_check(name, error, sigma, limits, text)
        for name, error, sigma, limits, text in (
            ("focal length", focal, found.lens_sigmas[0], (FOCAL_WARN, FOCAL_FAIL),
             f"a focal length {abs(focal):.1%} {longer}: check fx, fy and the image size"),
            ("radial distortion", radial, found.lens_sigmas[1], (RADIAL_WARN, RADIAL_FAIL),
             f"a first radial coefficient {radial:+.2f} from the rig's: check the distortion, and "
             "whether the images are undistorted already"),
            ("principal point", centre, found.lens_sigmas[2], (CENTRE_WARN, CENTRE_FAIL),
             f"a principal point {centre:+.1%} of a focal length from the rig's: check cx, cy, and "
             "whether the images were cropped"),
        )
    )  # fmt: skip


def _lens_check(
    name: str, error: float, sigma: float, limits: tuple[float, float], better: str
) -> Check:
    warn, fail = limits
    if not sigma < MAX_LENS_SIGMA * warn:
        text = f"the images do not tell the {name} well enough to check it"
        return Check(name, "PASS", text)
    status = grade(abs(error) > warn, abs(error) > fail)
    text = f"{name} agrees with the images" if status == "PASS" else f"the images fit {better}"
    return Check(name, status, text, error, warn, fail)


def _gain_check(found: ImageEvidence, lens: tuple[Check, ...]) -> tuple[Check, ...]:
    """Whether a pose nearby is better; not asked if that is the lens' doing."""
    if any(check.status != "PASS" for check in lens):
        return ()
    advice = "a pose nearby fits the images better; calibrate again from the result, check the lens"
    return (
        above("gain of the best pose nearby", found.gain, GAIN_WARN, GAIN_FAIL, "chance spreads",
              advice),
    )  # fmt: skip


def pairing_checks(found: ImageEvidence) -> tuple[Check, ...]:
    """Judge whether images and clouds belong together; nothing without neighbouring frames."""
    if math.isnan(found.pair_margin):
        return ()
    side = "next" if found.pair_offset > 0 else "previous"
    advice = (
        f"the images fit the clouds of the {side} frame better; check which image belongs to "
        "which cloud, and their time stamps"
    )
    return (
        below("own clouds' lead over neighbouring ones", found.pair_margin, PAIR_WARN, PAIR_FAIL,
              "share", advice),
    )  # fmt: skip


def offset_checks(offset: TimeOffset | None) -> tuple[Check, ...]:
    """Judge the time offset of one camera; nothing where it could not be measured."""
    if offset is None or math.isnan(offset.sigma):
        return ()
    name, size = "time offset", abs(offset.intervals)
    told = size > OFFSET_SIGMAS * offset.sigma
    status = grade(told and size > OFFSET_WARN, told and size > OFFSET_FAIL)
    text = f"time offset {offset.intervals:+.2f} +- {offset.sigma:.2f} frame intervals"
    if status != "PASS":
        when = "later" if offset.intervals > 0 else "earlier"
        text += f": the images were taken {when} than the clouds; correct the time stamps"
    return (Check(name, status, text, offset.intervals, OFFSET_WARN, OFFSET_FAIL, "intervals"),)
