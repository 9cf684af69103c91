"""What the posterior of a lens and clock says: checks, each with its value and what to do."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace

import numpy as np

from calibgraph.model.verdict import FAIL_ABOVE, PASS_BELOW, TOLERANCE, Check, Status
from calibgraph.trust.lens_posterior import TIME, LensParameter, LensPosterior
from calibgraph.trust.thresholds import threshold

_WORDS = {
    "focal length": ("focal", "a focal length {} % longer", "a focal length {} % shorter"),
    "distortion": ("distortion", "a k1 larger by {}", "a k1 smaller by {}"),
    "principal point": ("centre", "a principal point off by ({}) px", ""),
    "aspect ratio": ("aspect", "a ratio fx / fy {} % larger", "a ratio fx / fy {} % smaller"),
    "skew": (None, "a skew of {} % of fx", "a skew of -{} % of fx"),
    TIME: ("offset", "images taken {} ms later", "images taken {} ms earlier"),
}
"""Parameters that are judged: what ``--estimate`` calls them, and a lens with more or less."""

_PRIORS = {
    "focal": "intrinsics_sigma_px.focal",
    "centre": "intrinsics_sigma_px.centre",
    "distortion": "distortion_sigma",
    "offset": "time_offset_sigma_s",
}
"""Where a rig states how well they are known."""

RESIDUALS, IMAGES = "residuals over the image", "images"
"""What an estimate is by."""

KINDS = {
    by: {name: prefix + name.replace(" ", "_") for name in _WORDS}
    for by, prefix in ((RESIDUALS, "lens_"), (IMAGES, ""))
}
"""Kinds of the checks."""
LENS_KINDS = frozenset(kind for kinds in KINDS.values() for kind in kinds.values())
_PART_OF = {
    kind: part
    for kinds in KINDS.values()
    for name, kind in kinds.items()
    if (part := _WORDS[name][0]) is not None
}
_ESTIMATE = re.compile(r"(run with --estimate )\S+$")
_TOLD_S, _TOLD_CM = 0.01, 0.1  # of an offset that is not determined: whose effect is told


def check_lens(
    found: LensPosterior,
    by: str,
    tolerance: tuple[float, float] = TOLERANCE,
    estimated: Collection[str] = (),
) -> list[Check]:
    """Whether parameters of a lens are wrong: the value of a check is the probability.

    Args:
        found: the posterior.
        by: RESIDUALS or IMAGES.
        tolerance: of the user [deg, cm].
        estimated: parts that the result has estimated, as ``--estimate`` calls them.
    """
    return [check_parameter(each, by, estimated) for each in found.parameters(tolerance)]


def check_parameter(found: LensParameter, by: str, estimated: Collection[str] = ()) -> Check:
    """The check of one of them; of one that is not determined, it tells how much depends on it."""
    row, (deg, cm), (part, *_) = threshold("lens"), found.moved, _WORDS[found.name]
    status = row.grade(found.probability)
    text = f"by the {by}, {describe(found)}; the camera would move by {deg:.2g} deg, {cm:.2g} cm"
    if status != "PASS":
        text += f": {_advice(found.name, part, estimated)}"
    elif found.name == TIME and not found.is_determined:
        text = "the time of the images is not determined by these data, and taken for right"
        by_told_cm = 100 * float(np.linalg.norm(found.by_unit[3:, 0])) * _TOLD_S / found.units[0]
        if by_told_cm > _TOLD_CM:
            told = f"{1e3 * _TOLD_S:.0f} ms would move the camera by {by_told_cm:.2g} cm"
            text = f"{text}; {told}"
    name = f"{found.name} by the {by}: {row.name}"
    check = row.describe(found.probability, status, text, name=name)
    return replace(check, kind=KINDS[by][found.name])


def _advice(name: str, part: str | None, estimated: Collection[str]) -> str:
    if part in estimated:
        prior = f"{_PRIORS[part]} in the rig" if part in _PRIORS else "how well it is known"
        return f"it has been estimated, and its prior holds it back: state {prior} wider"
    advice = "correct the time stamps" if name == TIME else threshold("lens").advice
    return advice + (f"; or run with --estimate {part}" if part else "")


def describe(found: LensParameter) -> str:
    """The lens that would be right, in words."""
    _, more, less = _WORDS[found.name]
    units = found.units * (100 if "%" in more else 1000 if "ms" in more else 1)
    values = units * (np.abs(found.values) if less else found.values)
    numbers = ", ".join(map(_with_sigma, values, units * found.sigmas))
    return (less if less and found.values[0] < 0 else more).format(numbers)


def _with_sigma(value: float, sigma: float) -> str:
    """A number with its standard deviation, in two digits of that."""
    decimals = max(0, 1 - math.floor(math.log10(max(sigma, 1e-12))))
    return f"{value:.{decimals}f} +- {sigma:.{decimals}f}"


def advise_together(checks: Sequence[Check]) -> list[Check]:
    """The checks of a camera; of several parameters that look wrong, the advice is one.

    A wrong parameter makes others look wrong, since matches follow it. To estimate one of those
    alone would leave the camera where it is, with an error bar that does not hold.
    """
    look_wrong = {check.kind for check in checks if check.status != "PASS"}
    parts = {_PART_OF[kind] for kind in look_wrong & _PART_OF.keys()}
    if len(parts) < 2:  # noqa: PLR2004
        return list(checks)
    all_parts = ",".join(["lens", *sorted(parts & {"aspect", "offset"})])
    return [
        replace(check, text=_ESTIMATE.sub(rf"\1{all_parts}", check.text))
        if check.kind in _PART_OF
        else check
        for check in checks
    ]


def probability_of_lens(values: Iterable[tuple[str, Status, float | None]]) -> float:
    """The probability that the worst of the lens parameters is wrong.

    Args:
        values: kind, status and value of checks. One that is a WARN counts as one, whatever its
            value.
    """
    most: dict[Status, float] = {"FAIL": 1.0, "WARN": FAIL_ABOVE, "PASS": PASS_BELOW}
    of_lens = [(status, value) for kind, status, value in values if kind in LENS_KINDS]
    return max((min(value or 0.0, most[status]) for status, value in of_lens), default=0.0)
