"""The checks as rows of a table, and the reasons for WARN and FAIL, grouped over cameras."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from calibgraph.model.verdict import Check, Verdict, in_unit

_ROUNDED_FROM = 1000  # three digits would need an exponent


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


def check_row(check: Check) -> CheckRow:
    """A check with its thresholds; their order gives the side on which values are bad."""
    if check.value is None:
        return CheckRow(check, "", "", "")
    found = _quantity(check.value, check.unit)
    if check.warn is None or check.fail is None:
        return CheckRow(check, found, "", "")
    sign = "<" if check.warn > check.fail else ">"
    unreachable = sign == "<" and check.fail <= 0
    warn, fail = (_threshold(sign, limit, check.unit) for limit in (check.warn, check.fail))
    return CheckRow(check, found, warn, "" if unreachable else fail)


def _threshold(sign: str, limit: float, unit: str) -> str:
    return f"{sign} {_quantity(limit, unit)}" if math.isfinite(limit) else ""


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
            key = (check.status, check.name, check.unit, "" if measured else check.text)
            if check.status != "PASS":
                alike.setdefault(key, {})[camera] = check
    reasons = [Reason(key[0], ", ".join(each), _summary(each)) for key, each in alike.items()]
    reasons.sort(key=lambda reason: ("FAIL", "WARN").index(reason.status))
    return [*reasons, *_group_sentences(weaknesses)]


def _group_sentences(weaknesses: Mapping[str, Sequence[str]]) -> list[Reason]:
    cameras: dict[str, list[str]] = {}
    for camera, sentences in weaknesses.items():
        for sentence in sentences:
            cameras.setdefault(sentence, []).append(camera)
    return [Reason("", ", ".join(names), sentence) for sentence, names in cameras.items()]


def _summary(checks: Mapping[str, Check]) -> str:
    """The same check of several cameras in one sentence, with the advice of the first."""
    first = next(iter(checks.values()))
    limit = first.fail if first.status == "FAIL" else first.warn
    if len({check.text for check in checks.values()}) == 1 or limit is None:
        return first.text
    found = [f"{name} {_quantity(c.value or 0.0, c.unit)}" for name, c in checks.items()]
    advice = first.text.removeprefix(first.name).partition(": ")[2]
    text = f"{first.name}: {', '.join(found)}; limit {_quantity(limit, first.unit)}"
    return f"{text}: {advice}" if advice else text
