"""What the posterior of a lens and clock says: checks, each with its value and what to do."""

from __future__ import annotations

import math
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
_TOLD_S, _TOLD_CM = 0.01, 0.1  # of an offset that is not determined: whose effect is told


def check_lens(
    found: LensPosterior,
    by: str,
    tolerance: tuple[float, float] = TOLERANCE,
    estimated: Collection[str] = (),
) -> list[Check]:
    """Whether parameters of a lens are wrong: the value of a check is the probability.

    Of several that look wrong, the advice is to estimate all.

    Args:
        found: the posterior.
        by: RESIDUALS or IMAGES.
        tolerance: of the user [deg, cm].
        estimated: parts that the result has estimated, as ``--estimate`` calls them.
    """
    parameters, row = found.parameters(tolerance), threshold("lens")
    wrong = [each.name for each in parameters if row.grade(each.probability) != "PASS"]
    return [_check(each, by, _advice(wrong, each.name, estimated)) for each in parameters]


def _check(found: LensParameter, by: str, advice: str) -> Check:
    """The check of one of them; of one that is not determined, it tells how much depends on it."""
    row, (deg, cm) = threshold("lens"), found.moved
    status = row.grade(found.probability)
    text = f"by the {by}, {describe(found)}; the camera would move by {deg:.2g} deg, {cm:.2g} cm"
    if status != "PASS":
        text += f": {advice}"
    elif found.name == TIME and not found.is_determined:
        text = "the time of the images is not determined by these data, and taken for right"
        told_cm = 100 * float(np.linalg.norm(found.by_unit[3:, 0])) * _TOLD_S / found.units[0]
        if told_cm > _TOLD_CM:
            text += f"; {1e3 * _TOLD_S:.0f} ms would move the camera by {told_cm:.2g} cm"
    name = f"{found.name} by the {by}: {row.name}"
    check = row.describe(found.probability, status, text, name=name)
    return replace(check, kind=KINDS[by][found.name])


def _advice(wrong: Sequence[str], name: str, estimated: Collection[str]) -> str:
    """What to do about a parameter that looks wrong, as others may."""
    part = _WORDS[name][0]
    if part in estimated:
        prior = f"{_PRIORS[part]} in the rig" if part in _PRIORS else "how well it is known"
        return f"it has been estimated, and its prior holds it back: state {prior} wider"
    advice = "correct the time stamps" if name == TIME else threshold("lens").advice
    parts = [known for each in wrong if (known := _WORDS[each][0])]
    return advice + (f"; or run with --estimate {','.join(parts)}" if part else "")


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


def probability_of_lens(values: Iterable[tuple[str, Status, float | None]]) -> float:
    """The probability that the worst of the lens parameters is wrong.

    Args:
        values: kind, status and value of checks. One that is a WARN counts as one, whatever its
            value.
    """
    most: dict[Status, float] = {"FAIL": 1.0, "WARN": FAIL_ABOVE, "PASS": PASS_BELOW}
    of_lens = [(status, value) for kind, status, value in values if kind in LENS_KINDS]
    return max((min(value or 0.0, most[status]) for status, value in of_lens), default=0.0)
