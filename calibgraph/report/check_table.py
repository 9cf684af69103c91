"""The checks as rows of a table, and the reasons for WARN and FAIL, grouped over cameras."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from calibgraph.model.threshold import Direction, in_unit, is_reachable
from calibgraph.model.verdict import Check, Verdict

_ROUNDED_FROM = 1000  # three digits would need an exponent
_WORST_FIRST = ("FAIL", "WARN", "PASS")
_NUMBER = re.compile(r"(-?\d+(?:\.\d+)?)")


@dataclass(frozen=True)
class CheckRow:
    """One check with its value and its thresholds, as text; empty where there is none."""

    check: Check
    found: str
    warn: str
    fail: str


@dataclass(frozen=True)
class Reason:
    """Why a result is not PASS: one finding, and its cameras; status is empty for a weakness."""

    status: str
    cameras: str
    text: str


def check_rows(checks: Sequence[Check]) -> tuple[CheckRow, ...]:
    """The rows of a camera's checks, the worst first."""
    return tuple(check_row(check) for check in sorted(checks, key=_severity))


def _severity(check: Check) -> int:
    return _WORST_FIRST.index(check.status)


def check_row(check: Check) -> CheckRow:
    """A check with its thresholds; their order gives the side on which values are bad."""
    if check.value is None:
        return CheckRow(check, "", "", "")
    found = _quantity(check.value, check.unit)
    if check.warn is None or check.fail is None:
        return CheckRow(check, found, "", "")
    side: Direction = "at least" if check.warn > check.fail else "at most"
    warn, fail = (_threshold(side, limit, check.unit) for limit in (check.warn, check.fail))
    return CheckRow(check, found, warn, fail)


def _threshold(side: Direction, limit: float, unit: str) -> str:
    """When a value is bad; empty if no value can be."""
    sign = ">" if side == "at most" else "<"
    return f"{sign} {_quantity(limit, unit)}" if is_reachable(limit, unit, side) else ""


def _quantity(value: float, unit: str) -> str:
    """A number with its unit; large ones without an exponent."""
    if unit != "share" and _ROUNDED_FROM <= abs(value) < math.inf:
        return f"{value:.0f} {unit}".rstrip()
    return in_unit(value, unit)


def group_reasons(
    verdicts: Mapping[str, Verdict], weaknesses: Mapping[str, Sequence[str]]
) -> list[Reason]:
    """The checks that are not PASS, FAIL first, then the weaknesses; equal ones once.

    Args:
        verdicts: per camera.
        weaknesses: sentences per camera.
    """
    alike: dict[tuple[str, ...], dict[str, Check]] = {}
    for camera, verdict in verdicts.items():
        for check in verdict.checks:
            measured = check.value is not None and check.warn is not None
            key = (check.name, check.unit, "" if measured else _NUMBER.sub("", check.text))
            if check.status != "PASS":
                alike.setdefault(key, {})[camera] = check
    reasons = [_reason(each) for each in alike.values()]
    reasons.sort(key=lambda reason: _WORST_FIRST.index(reason.status))
    return [*_doubts(verdicts), *reasons, *_group_sentences(weaknesses)]


def _doubts(verdicts: Mapping[str, Verdict]) -> list[Reason]:
    """How probable it is that cameras are off, the worst first, in one sentence."""
    found = {n: v.doubt for n, v in verdicts.items() if v.doubt and v.doubt.status != "PASS"}
    if not found:
        return []
    ordered = sorted(found.items(), key=lambda item: (item[1].status, -item[1].probability))
    worst = ordered[0][1]
    percents = ", ".join(doubt.percent for _, doubt in ordered)
    text = f"{worst.sentence} of {percents}{worst.advice}"
    return [Reason(worst.status, ", ".join(name for name, _ in ordered), text)]


def _reason(checks: Mapping[str, Check]) -> Reason:
    """The same check of several cameras, the worst first."""
    ordered = dict(sorted(checks.items(), key=lambda item: _severity(item[1])))
    return Reason(next(iter(ordered.values())).status, ", ".join(ordered), _summary(ordered))


def _group_sentences(weaknesses: Mapping[str, Sequence[str]]) -> list[Reason]:
    cameras: dict[str, list[str]] = {}
    for camera, sentences in weaknesses.items():
        for sentence in sentences:
            cameras.setdefault(sentence, []).append(camera)
    return [Reason("", ", ".join(names), sentence) for sentence, names in cameras.items()]


def _summary(checks: Mapping[str, Check]) -> str:
    """The same check of several cameras in one sentence, with the advice of the first."""
    first = next(iter(checks.values()))
    texts = [check.text for check in checks.values()]
    if len(set(texts)) == 1 or first.warn is None:
        return _merge_numbers(texts)
    advice = first.text.removeprefix(first.name).partition(": ")[2]
    text = f"{first.name}: {_values(checks)}"
    return f"{text}: {advice}" if advice else text


def _values(checks: Mapping[str, Check]) -> str:
    """The values of all cameras, by status, each with its limit."""
    parts = []
    for status in _WORST_FIRST:
        of_status = {name: check for name, check in checks.items() if check.status == status}
        for check in list(of_status.values())[:1]:
            limit = (check.fail if status == "FAIL" else check.warn) or 0.0
            found = [f"{n} {_quantity(c.value or 0.0, c.unit)}" for n, c in of_status.items()]
            parts.append(f"{', '.join(found)} ({status}: limit {_quantity(limit, check.unit)})")
    return "; ".join(parts)


def _merge_numbers(texts: Sequence[str]) -> str:
    """Sentences that differ in their numbers at most, as one with the numbers of all."""
    parts = zip(*(_NUMBER.split(text) for text in texts), strict=True)
    return "".join(", ".join(dict.fromkeys(part)) for part in parts)
