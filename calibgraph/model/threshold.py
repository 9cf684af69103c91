"""The limits of measured numbers, and the checks of a number by its limits."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from calibgraph.model.verdict import TOLERANCE, Check, Status, grade

Direction = Literal["at most", "at least"]

_CELL = 7  # characters of a number, of which eight and a name fit on 80 columns
_LARGEST = {"share": 1.0, "deg": 180.0}  # that a value can be


@dataclass(frozen=True)
class Threshold:
    """The limits of one measured number: a row of the table in ``trust.thresholds``.

    Attributes:
        key: by which checks look the row up.
        name: of the measured number and its check.
        direction: "at most" or "at least": on which side of the limits PASS lies.
        warn: the last value that is PASS.
        fail: the last value that is not FAIL.
        unit: of the values; "share" is printed in percent.
        question: what the check answers, in words.
        reason: why these limits: what they mean, or the data that they were read from.
        advice: the meaning if it is not PASS; for what to do, see ``model.causes``.
        of_tolerance: whether the limits are for the default tolerance, and scale with another one.
    """

    key: str
    name: str
    direction: Direction
    warn: float
    fail: float
    unit: str
    question: str
    reason: str
    advice: str = ""
    of_tolerance: bool = False

    def at(self, tolerance: tuple[float, float]) -> Threshold:
        """The row for a tolerance [deg, cm].

        A tolerance below the default moves the limit of PASS alone: an error of that size is too
        large for the user, but no sign of a wrong result.
        """
        if not self.of_tolerance:
            return self
        ratio = ratio_of(self.unit, tolerance)
        return replace(self, warn=self.warn * ratio, fail=self.fail * max(ratio, 1.0))

    def grade(self, value: float) -> Status:
        """PASS, WARN or FAIL of a value; NaN fails."""
        if self.direction == "at most":
            return grade(not value <= self.warn, not value <= self.fail)
        return grade(not value >= self.warn, not value >= self.fail)

    def check(self, value: float, *, name: str = "", advice: str = "") -> Check:
        """The check of a value."""
        status, name, meaning = self.grade(value), name or self.name, advice or self.advice
        limit = self.fail if status == "FAIL" else self.warn
        text = f"{name}: {beside(value, limit, self.unit)}"
        if status != "PASS":
            side = "above" if self.direction == "at most" else "below"
            text += f", {side} the limit {in_unit(limit, self.unit)}"
            text += f": {meaning}" if meaning else ""
        return self.describe(float(value), status, text, name=name)

    def describe(self, value: float, status: Status, text: str, *, name: str = "") -> Check:
        """A check whose sentence, and perhaps status, depend on more than the value."""
        limits = (self.warn, self.fail, self.unit)
        return Check(name or self.name, status, text, value, *limits, kind=self.key)


def ratio_of(unit: str, tolerance: tuple[float, float]) -> float:
    """A tolerance [deg, cm] over the default one: that of the rotation or of the distance."""
    return tolerance[("deg", "cm").index(unit)] / TOLERANCE[("deg", "cm").index(unit)]


def is_reachable(limit: float, unit: str, direction: Direction) -> bool:
    """Whether a value can lie beyond a limit.

    Args:
        limit: of the value.
        unit: of the value; a count is not negative, a share of a score can be.
        direction: "at most" or "at least": on which side of the limit PASS lies.
    """
    if direction == "at most":
        return limit < _LARGEST.get(unit, math.inf)
    return limit > 0 or unit == "share"


def in_unit(value: float, unit: str, digits: int = 3) -> str:
    """A number with its unit, for display; large ones without an exponent."""
    scaled, sign = (100 * value, "%") if unit == "share" else (value, f" {unit}".rstrip())
    if 10**digits <= abs(scaled) < math.inf:
        return f"{scaled:.0f}{sign}"
    return f"{scaled:.{digits}g}{sign}"


def fixed(value: float, decimals: int, sign: str = "") -> str:
    """A number for a cell, of at most seven characters: a large one has fewer decimals."""
    texts = (f"{value:{sign}.{places}f}" for places in range(decimals, -1, -1))
    return next((text for text in texts if len(text) <= _CELL), f"{value:{sign}.0e}")


def beside(value: float, limit: float, unit: str) -> str:
    """A number with its unit, in three digits that tell it from a limit beyond which it lies.

    Where these would be the same, the number is rounded away from the limit.
    """
    text = in_unit(value, unit)
    if value == limit or text != in_unit(limit, unit):
        return text
    scaled = 100 * limit if unit == "share" else limit
    step = 10.0 ** min(math.floor(math.log10(abs(scaled))) - 2, 0)
    away = round(scaled / step) + (1 if value > limit else -1)
    return in_unit(away * step / (100 if unit == "share" else 1), unit)
