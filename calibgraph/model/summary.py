"""A verdict for people: at most three reasons by their causes, and actions; the rest folded.

Terminal, report, service, fleet and files show the same :class:`Summary`.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from calibgraph.model.causes import CAUSES, action_of, cause_of
from calibgraph.model.error_sources import ErrorSources
from calibgraph.model.threshold import beside, in_unit
from calibgraph.model.verdict import TOLERANCE, Check, Status, Verdict, rig_verdict

MOST = 3
"""Reasons and actions that are shown; the others are folded."""

_CANNOT_TELL = "cannot tell: "
_OF_DATA = ("error bar", "data", "repeats")  # causes
_WORST_FIRST: tuple[Status, ...] = ("FAIL", "WARN", "PASS")
_PARTS = re.compile(r"--estimate [a-z,]+(?: --(?:interval-s [\d.]*\d|motion scans))?")
_NUMBER = re.compile(r"(-?\d+(?:\.\d+)?)")


@dataclass(frozen=True)
class Reason:
    """Why a result is not PASS: one finding, and its cameras.

    Attributes:
        status: WARN or FAIL; empty for a weakness, which no check is about.
        cameras: their names, the worst first.
        text: one sentence.
        cause: its key in ``CAUSES``; empty for a weakness.
        action: what to do about it; empty if nothing that a user can do would help.
        kind: of its check; empty if it is of none.
    """

    status: str
    cameras: tuple[str, ...]
    text: str
    cause: str = ""
    action: str = ""
    kind: str = ""


@dataclass(frozen=True)
class Summary:
    """A verdict in few words.

    Attributes:
        status: PASS, WARN or FAIL.
        cannot_tell: whether the first reason is that the data cannot tell.
        error_probability: per camera, that it is off, in one sentence; empty for a PASS.
        reasons: at most three, each of another cause, the worst first.
        actions: what to do, at most three sentences, each once.
        error_bar: the largest error bar beside the tolerance, and the shares of its sources; empty
            if there is none.
        others: the other findings, the worst first, then the weaknesses.
    """

    status: Status
    cannot_tell: bool
    error_probability: str
    reasons: tuple[Reason, ...]
    actions: tuple[str, ...]
    error_bar: str
    others: tuple[Reason, ...]

    def to_mapping(self) -> dict[str, Any]:
        """As plain values, for YAML and JSON."""
        return {key: _plain(value) for key, value in asdict(self).items()}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, (list, tuple)) else value


def summarize(
    verdicts: Mapping[str, Verdict],
    weaknesses: Mapping[str, Sequence[str]] | None = None,
    sources: Mapping[str, ErrorSources] | None = None,
) -> Summary:
    """The verdict of a rig, or of one camera, in few words."""
    of_rig, known = rig_verdict(verdicts, named=False), sources or {}
    tolerance = (
        TOLERANCE if of_rig.error_probability is None else of_rig.error_probability.tolerance
    )
    findings = [*_unsure(verdicts), *_findings(verdicts)] or _nearest(verdicts)
    by_cause: dict[str, list[Reason]] = {}
    for finding in sorted(findings, key=_rank):
        by_cause.setdefault(finding.cause, []).append(finding)
    grouped = [_with_other_cameras(each) for each in by_cause.values()]
    if of_rig.cannot_tell:
        grouped = _unsure_first(grouped)
    shown = [*grouped[:MOST]]
    shown[:1] = [_with_action_for(reason, known, tolerance) for reason in shown[:1]]
    known = {name: one for name, one in known.items() if verdicts[name].status != "FAIL"}
    shown[1:] = [_with_action_for(reason, known, tolerance) for reason in shown[1:]]
    folded = [reason for each in by_cause.values() for reason in each[1:]] + grouped[MOST:]
    actions = dict.fromkeys(reason.action for reason in shown if reason.action)
    return Summary(
        of_rig.status,
        of_rig.cannot_tell,
        _error_probabilities(verdicts),
        tuple(shown),
        tuple(actions)[:MOST],
        _error_bar(known, tolerance),
        (*sorted(folded, key=_rank), *_group_sentences(weaknesses or {})),
    )


def _with_action_for(
    reason: Reason, sources: Mapping[str, ErrorSources], tolerance: tuple[float, float]
) -> Reason:
    """The reason with the action that shrinks the largest error bar, if the bar is the reason."""
    known = [sources[name] for name in reason.cameras if name in sources]
    if CAUSES[reason.cause].action or not known:
        return reason
    largest = max(known, key=lambda one: one.over_tolerance(tolerance))
    return replace(reason, action=largest.action(tolerance))


def _error_bar(sources: Mapping[str, ErrorSources], tolerance: tuple[float, float]) -> str:
    """The camera whose error bar is largest beside the tolerance, in one sentence."""
    if not sources:
        return ""
    name = max(sources, key=lambda one: sources[one].over_tolerance(tolerance))
    return f"accuracy of {name}, 1 sigma: {sources[name].describe(tolerance)}"


def _rank(reason: Reason) -> tuple[int, int]:
    """Worse ones first, then those that explain the others."""
    return _WORST_FIRST.index(reason.status), list(CAUSES).index(reason.cause)


def _unsure_first(reasons: Sequence[Reason]) -> list[Reason]:
    """Reasons about too little data before others, the first marked "cannot tell"."""
    first, *others = sorted(reasons, key=lambda reason: reason.cause not in _OF_DATA)
    text = f"{_CANNOT_TELL}{first.text.removeprefix(_CANNOT_TELL)}"
    return [replace(first, text=text), *others]


def _with_other_cameras(reasons: Sequence[Reason]) -> Reason:
    """The first reason of a cause, and at which other cameras a check of its kind is not PASS."""
    first = reasons[0]
    alike = (reason for reason in reasons if reason.kind == first.kind)
    others = dict.fromkeys(name for reason in alike for name in reason.cameras)
    names = [name for name in others if name not in first.cameras]
    also = f" (also noticed at {', '.join(names)})" if names else ""
    return replace(first, text=f"{first.text}{also}")


def _unsure(verdicts: Mapping[str, Verdict]) -> list[Reason]:
    """The reason that the error bar is too wide for the tolerance, with its cameras."""
    found = {
        n: v.error_probability
        for n, v in verdicts.items()
        if v.error_probability is not None and v.error_probability.of_error_bar
    }
    if not found:
        return []
    tolerated = next(iter(found.values())).tolerated
    text = f"{_CANNOT_TELL}the error bar is too wide for a tolerance of {tolerated}"
    return [Reason("WARN", tuple(found), text, "error bar")]


def _error_probabilities(verdicts: Mapping[str, Verdict]) -> str:
    """The probabilities that cameras are off, the worst first, in one sentence."""
    found = {
        n: v.error_probability
        for n, v in verdicts.items()
        if v.error_probability and v.error_probability.status != "PASS"
    }
    ordered = sorted(found.items(), key=lambda item: (item[1].status, -item[1].probability))
    if not ordered:
        return ""
    percents = ", ".join(f"{name} {found.percent}" for name, found in ordered)
    return f"{ordered[0][1].sentence}: {percents}"


def _findings(verdicts: Mapping[str, Verdict]) -> list[Reason]:
    """The checks that are not PASS, equal ones of several cameras once, the most severe first."""
    alike: dict[tuple[str, ...], dict[str, Check]] = {}
    for camera, verdict in verdicts.items():
        for check in verdict.checks:
            key = (check.name, check.unit, "" if check.is_graded else _NUMBER.sub("", check.text))
            if check.status != "PASS":
                alike.setdefault(key, {})[camera] = check
    severest = sorted(alike.values(), key=lambda of: -max(check.severity for check in of.values()))
    return [_reason(each) for each in severest]


def _nearest(verdicts: Mapping[str, Verdict]) -> list[Reason]:
    """The check nearest its limit, of cameras that may be off though all their checks PASS."""
    doubtful = {
        n: v
        for n, v in verdicts.items()
        if v.error_probability and v.error_probability.status != "PASS"
    }
    checks = [(name, check) for name, verdict in doubtful.items() for check in verdict.checks]
    if not checks:
        return []
    name, check = max(checks, key=lambda item: item[1].severity)
    kind, status = check.kind or check.name, rig_verdict(doubtful).status
    text = f"no check is beyond its limit; nearest to it is {check.text}"
    return [Reason(status, (name,), text, cause_of(kind), action_of(kind), kind)]


def _reason(checks: Mapping[str, Check]) -> Reason:
    """The same check of several cameras, the worst first."""
    ordered = dict(sorted(checks.items(), key=lambda item: -item[1].severity))
    worst = next(iter(ordered.values()))
    kind = worst.kind or worst.name
    cameras, text, action = tuple(ordered), _sentence(ordered), action_of(kind)
    if parts := _PARTS.search(worst.text):  # several that look wrong are estimated together
        action = _PARTS.sub(parts[0], action)
    return Reason(worst.status, cameras, text, cause_of(kind), action, kind)


def _group_sentences(weaknesses: Mapping[str, Sequence[str]]) -> list[Reason]:
    cameras: dict[str, list[str]] = {}
    for camera, sentences in weaknesses.items():
        for sentence in sentences:
            cameras.setdefault(sentence, []).append(camera)
    return [Reason("", tuple(names), sentence) for sentence, names in cameras.items()]


def _sentence(checks: Mapping[str, Check]) -> str:
    """The same check of several cameras in one sentence, with the meaning of the first."""
    first = next(iter(checks.values()))
    texts = [check.text for check in checks.values()]
    if len(set(texts)) == 1 or not first.is_graded:
        return _merge_numbers(texts)
    meaning = first.text.removeprefix(first.name).partition(": ")[2]
    text = f"{first.name}: {_values(checks)}"
    return f"{text}: {meaning}" if meaning else text


def _values(checks: Mapping[str, Check]) -> str:
    """The values of all cameras, by status, each with its limit."""
    parts = []
    for status in _WORST_FIRST:
        of_status = {name: check for name, check in checks.items() if check.status == status}
        for check in list(of_status.values())[:1]:
            limit = (check.fail if status == "FAIL" else check.warn) or 0.0
            found = [f"{n} {beside(c.value or 0.0, limit, c.unit)}" for n, c in of_status.items()]
            parts.append(f"{', '.join(found)} ({status}: limit {in_unit(limit, check.unit)})")
    return "; ".join(parts)


def _merge_numbers(texts: Sequence[str]) -> str:
    """Sentences that differ in their numbers at most, as one with the numbers of all."""
    parts = zip(*(_NUMBER.split(text) for text in texts), strict=True)
    return "".join(", ".join(dict.fromkeys(part)) for part in parts)
