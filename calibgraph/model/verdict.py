"""Questions asked of a result, with what was found and the thresholds it met; their verdict."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

Status = Literal["PASS", "WARN", "FAIL"]

_ORDER: tuple[Status, ...] = ("PASS", "WARN", "FAIL")


@dataclass(frozen=True)
class Check:
    """One question asked of one camera's result.

    Attributes:
        name: what was measured or looked for.
        status: PASS, WARN or FAIL.
        text: a sentence that says what was found and, if that is not PASS, what to do.
        value: what was found, where it is a number.
        warn: the threshold from which on it is WARN, where there is one.
        fail: the threshold from which on it is FAIL, where there is one.
        unit: of the three.
    """

    name: str
    status: Status
    text: str
    value: float | None = None
    warn: float | None = None
    fail: float | None = None
    unit: str = ""


@dataclass(frozen=True)
class Verdict:
    """Whether a result can be used.

    Attributes:
        checks: everything that was asked, in order.
    """

    checks: tuple[Check, ...] = ()

    @property
    def status(self) -> Status:
        """The worst of the checks."""
        return max((check.status for check in self.checks), key=_ORDER.index, default="PASS")

    @property
    def reasons(self) -> tuple[str, ...]:
        """What was found wanting, the worst first, a sentence each; empty for PASS."""
        wanting = [check for check in self.checks if check.status != "PASS"]
        wanting.sort(key=lambda check: -_ORDER.index(check.status))
        return tuple(check.text for check in wanting)

    def and_first(self, checks: Iterable[Check]) -> Verdict:
        """The verdict with checks that name a cause, which come before the others."""
        return Verdict((*checks, *self.checks))

    def and_also(self, checks: Iterable[Check]) -> Verdict:
        """The verdict with more checks."""
        return Verdict((*self.checks, *checks))


def rig_verdict(cameras: Mapping[str, Verdict]) -> Verdict:
    """The verdict of a rig: the checks of all its cameras, with their names."""
    return Verdict(
        tuple(
            replace(check, text=f"{name}: {check.text}")
            for name, verdict in cameras.items()
            for check in verdict.checks
        )
    )


def above(  # noqa: PLR0913, PLR0917 - a line of a table
    name: str, value: float, warn: float, fail: float, unit: str, advice: str = ""
) -> Check:
    """A check that a number is not above two thresholds; NaN fails.

    Args:
        name: what was measured.
        value: what was found.
        warn: the largest value that is PASS.
        fail: the largest value that is not FAIL.
        unit: of the values; "share" prints percents.
        advice: what to do if it is above.
    """
    status = grade(not value <= warn, not value <= fail)
    return _measured(name, status, "above", value, warn, fail, unit, advice)


def below(  # noqa: PLR0913, PLR0917 - a line of a table
    name: str, value: float, warn: float, fail: float, unit: str, advice: str = ""
) -> Check:
    """A check that a number is not below two thresholds; NaN fails. Arguments as of `above`."""
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


def in_unit(value: float, unit: str, digits: int = 3) -> str:
    """A number with its unit, as people read it."""
    if unit == "share":
        return f"{100 * value:.{digits}g}%"
    return f"{value:.{digits}g} {unit}".rstrip()
