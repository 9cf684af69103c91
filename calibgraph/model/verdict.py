"""Checks: a number or finding, its limits, and PASS, WARN or FAIL; the verdict is the worst."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

Status = Literal["PASS", "WARN", "FAIL"]
Direction = Literal["at most", "at least"]

_ORDER: tuple[Status, ...] = ("PASS", "WARN", "FAIL")
_LARGEST = {"share": 1.0, "deg": 180.0}  # that a value can be


@dataclass(frozen=True)
class Check:
    """One check of one camera's result.

    Attributes:
        name: what was measured or searched for.
        status: PASS, WARN or FAIL.
        text: one sentence: what was found and, if that is not PASS, what to do.
        value: the number that was found, if it is one.
        warn: the limit of PASS, which itself passes, if there is one.
        fail: the limit of WARN, which itself does not fail, if there is one.
        unit: of value, warn and fail.
        kind: what it is of, the same for all cameras and numbers; the name if it is empty.
    """

    name: str
    status: Status
    text: str
    value: float | None = None
    warn: float | None = None
    fail: float | None = None
    unit: str = ""
    kind: str = ""

    @property
    def severity(self) -> float:
        """How bad it is: 0 to 1 is PASS, 1 to 2 WARN, 2 to 3 FAIL, without steps at the limits."""
        low = float(_ORDER.index(self.status))
        if self.value is None or self.warn is None or self.fail is None:
            return low + 0.5 if low else 0.0
        if math.isnan(self.value):
            return low + 1.0
        return float(min(max(_between(self.value, self.warn, self.fail), low), low + 1.0))


def _between(value: float, warn: float, fail: float) -> float:
    """Where a value is: below 1 before the limit of PASS, 2 at that of WARN, 3 far beyond it.

    Which side is good is seen from the limits; of equal ones, or of one without a FAIL limit, the
    share of the first limit counts.
    """
    at_most = warn <= fail
    before, beyond = (value <= warn, value > fail) if at_most else (value >= warn, value < fail)
    if before:
        return _share(value, warn) if at_most else _share(warn, value)
    if beyond:
        return 3.0 - (_share(fail, value) if at_most else _share(value, fail))
    if math.isinf(fail):
        return 2.0 - _share(warn, value)
    return 1.0 + (value - warn) / (fail - warn)


def _share(part: float, whole: float) -> float:
    """A ratio of two numbers of one sign, 0 to 1; else 0."""
    return min(max(part / whole, 0.0), 1.0) if whole and math.isfinite(whole) else 0.0


@dataclass(frozen=True)
class Verdict:
    """Whether a result can be used.

    Attributes:
        checks: all checks, in order.
    """

    checks: tuple[Check, ...] = ()

    @property
    def status(self) -> Status:
        """The worst status of the checks; PASS without any."""
        return max((check.status for check in self.checks), key=_ORDER.index, default="PASS")

    @property
    def reasons(self) -> tuple[str, ...]:
        """The sentences of the checks that are not PASS, the worst first."""
        failing = [check for check in self.checks if check.status != "PASS"]
        failing.sort(key=lambda check: -_ORDER.index(check.status))
        return tuple(check.text for check in failing)


def rig_verdict(cameras: Mapping[str, Verdict]) -> Verdict:
    """The verdict of a rig: the checks of all its cameras, with the cameras' names."""
    return Verdict(
        tuple(
            replace(check, text=f"{name}: {check.text}")
            for name, verdict in cameras.items()
            for check in verdict.checks
        )
    )


@dataclass(frozen=True)
class Threshold:
    """The limits of one measured number: a row of the table in ``trust.thresholds``.

    Attributes:
        key: by which checks look the row up.
        name: what is measured; the name of the check.
        direction: "at most" or "at least": on which side of the limits PASS lies.
        warn: the last value that is PASS.
        fail: the last value that is not FAIL.
        unit: of the values; "share" is printed in percent.
        question: what the check answers, in words.
        reason: why these limits: what they mean, or the data that they were read from.
        advice: what to do if it is not PASS.
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

    def grade(self, value: float) -> Status:
        """PASS, WARN or FAIL of a value; NaN fails."""
        return self.check(value).status

    def check(self, value: float, *, name: str = "", advice: str = "") -> Check:
        """The check of a value.

        Args:
            value: in the row's unit.
            name: in place of the row's, where it depends on the data.
            advice: likewise.
        """
        build = at_most if self.direction == "at most" else at_least
        check = build(
            name or self.name, value, self.warn, self.fail, self.unit, advice or self.advice
        )
        return replace(check, kind=self.key)

    def describe(self, value: float, status: Status, text: str, *, name: str = "") -> Check:
        """A check whose sentence, and perhaps status, depend on more than the value."""
        limits = (self.warn, self.fail, self.unit)
        return Check(name or self.name, status, text, value, *limits, kind=self.key)


def at_most(  # noqa: PLR0913, PLR0917 - a line of a table
    name: str, value: float, warn: float, fail: float, unit: str, advice: str = ""
) -> Check:
    """A check that a number is at most its limits; NaN fails.

    Args:
        name: what was measured.
        value: what was found.
        warn: the largest value that is PASS.
        fail: the largest value that is not FAIL.
        unit: of the values; "share" is printed in percent.
        advice: what to do if it is above.
    """
    status = grade(not value <= warn, not value <= fail)
    return _measured(name, status, "above", value, warn, fail, unit, advice)


def at_least(  # noqa: PLR0913, PLR0917 - a line of a table
    name: str, value: float, warn: float, fail: float, unit: str, advice: str = ""
) -> Check:
    """A check that a number is at least its limits; NaN fails. Arguments as of `at_most`."""
    status = grade(not value >= warn, not value >= fail)
    return _measured(name, status, "below", value, warn, fail, unit, advice)


def grade(warn: bool, fail: bool) -> Status:
    """FAIL, else WARN, else PASS."""
    return "FAIL" if fail else "WARN" if warn else "PASS"


def _measured(  # noqa: PLR0913, PLR0917 - private, two calls
    name: str,
    status: Status,
    side: str,
    value: float,
    warn: float,
    fail: float,
    unit: str,
    advice: str,
) -> Check:
    limit = fail if status == "FAIL" else warn
    digits = 3 if status == "PASS" or in_unit(value, unit) != in_unit(limit, unit) else 9
    text = f"{name} {in_unit(value, unit, digits)}"
    if status != "PASS":
        text += f" is {side} {in_unit(limit, unit)}"
        text += f": {advice}" if advice else ""
    return Check(name, status, text, float(value), warn, fail, unit)


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
    """A number with its unit, for display."""
    if unit == "share":
        return f"{100 * value:.{digits}g}%"
    return f"{value:.{digits}g} {unit}".rstrip()
