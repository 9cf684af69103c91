"""The checks as rows of a table."""

from collections.abc import Sequence
from dataclasses import dataclass

from calibgraph.model.threshold import Direction, beside, in_unit, is_reachable
from calibgraph.model.verdict import Check

_WORST_FIRST = ("FAIL", "WARN", "PASS")


@dataclass(frozen=True)
class CheckRow:
    """One check with its value and its thresholds, as text; empty where there is none."""

    check: Check
    found: str
    warn: str
    fail: str


def check_rows(checks: Sequence[Check]) -> tuple[CheckRow, ...]:
    """The rows of a camera's checks, the worst first."""
    return tuple(check_row(check) for check in sorted(checks, key=_severity))


def _severity(check: Check) -> int:
    return _WORST_FIRST.index(check.status)


def check_row(check: Check) -> CheckRow:
    """A check with its thresholds; their order gives the side on which values are bad.

    A status that the value does not give, since it depends on more, has none.
    """
    if check.value is None:
        return CheckRow(check, "", "", "")
    if check.warn is None or check.fail is None or not check.is_graded:
        return CheckRow(check, in_unit(check.value, check.unit), "", "")
    side: Direction = "at least" if check.warn > check.fail else "at most"
    warn, fail = (_threshold(side, limit, check.unit) for limit in (check.warn, check.fail))
    found = beside(check.value, check.fail if check.status == "FAIL" else check.warn, check.unit)
    return CheckRow(check, found, warn, fail)


def _threshold(side: Direction, limit: float, unit: str) -> str:
    """When a value is bad; empty if no value can be."""
    sign = ">" if side == "at most" else "<"
    return f"{sign} {in_unit(limit, unit)}" if is_reachable(limit, unit, side) else ""
