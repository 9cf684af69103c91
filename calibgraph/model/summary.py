"""A verdict for people: the worst reasons of every camera, and actions; the rest folded.

Terminal, report, service, fleet and files show the same :class:`Summary`.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from calibgraph.model.causes import CAUSES, action_of, cause_of
from calibgraph.model.error_sources import ErrorSources
from calibgraph.model.verdict import (
    BRIGHTNESS,
    TOLERANCE,
    Check,
    Status,
    Verdict,
    beside,
    in_unit,
    rig_verdict,
)

LEAST = 3
"""Reasons that are shown if there are so many: more only where each is the worst of a camera."""

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
        reasons: one per camera and cause, the worst first: every camera's worst, and others up to
            three in all.
        actions: what to do about these, each sentence once, with the cameras that it is for.
        error_bar: the largest error bar beside the tolerance, and what would shrink it most; empty
            if there is none.
        others: the other findings, the worst first, then the weaknesses.
        moves: of ``track``: what moved, since when, how far.
    """

    status: Status
    cannot_tell: bool
    error_probability: str
    reasons: tuple[Reason, ...]
    actions: tuple[str, ...]
    error_bar: str
    others: tuple[Reason, ...]
    moves: tuple[str, ...] = ()


def summarize(
    verdicts: Mapping[str, Verdict],
    weaknesses: Mapping[str, Sequence[str]] | None = None,
    sources: Mapping[str, ErrorSources] | None = None,
    moves: Sequence[str] = (),
) -> Summary:
    """The verdict of a rig, or of one camera, in few words."""
    of_rig, known = rig_verdict(verdicts), sources or {}
    tolerance = of_rig.error_probability.tolerance if of_rig.error_probability else TOLERANCE
    worst, others = _by_cause(verdicts)
    reasons = sorted([*_unsure(verdicts), *_findings(worst), *_nearest(verdicts)], key=_rank)
    if of_rig.cannot_tell:
        reasons = _unsure_first(reasons)
    shown = _shown(reasons)
    folded = [*_findings(others), *(reason for reason in reasons if reason not in shown)]
    explained: set[str] = set()  # cameras that FAIL for a worse reason: their bar does not hold
    for at, reason in enumerate(shown):
        of = {n: known[n] for n in reason.cameras if n in known and n not in explained}
        if of and not CAUSES[reason.cause].action:  # the bar is the reason
            action = of[_largest(of, tolerance)].action(tolerance)
            shown[at] = replace(reason, action=action)
        explained.update(n for n in reason.cameras if verdicts[n].status == "FAIL")
    hold = {name: one for name, one in known.items() if verdicts[name].status != "FAIL"}
    name = _largest(hold, tolerance)
    return Summary(
        of_rig.status,
        of_rig.cannot_tell,
        _error_probabilities(verdicts),
        tuple(shown),
        _actions(shown, verdicts),
        f"Least certain: {name}, {hold[name].describe(tolerance)}" if name else "",
        (*sorted(folded, key=_rank), *_group_sentences(weaknesses or {})),
        tuple(moves),
    )


_Checks = dict[str, list[Check]]


def _by_cause(verdicts: Mapping[str, Verdict]) -> tuple[_Checks, _Checks]:
    """Per camera, the worst check of each cause that is not PASS; and the others."""
    worst: _Checks = {}
    others: _Checks = {}
    for camera, verdict in verdicts.items():
        causes: set[str] = set()
        dark = [check for check in verdict.checks if check.name == BRIGHTNESS]
        # Dark images explain all others, whose advice would be untrue.
        for check in sorted(dark or verdict.checks, key=lambda check: -check.severity):
            cause = cause_of(check.kind or check.name)
            if check.status != "PASS":
                (others if cause in causes else worst).setdefault(camera, []).append(check)
                causes.add(cause)
    return worst, others


def _shown(reasons: Sequence[Reason]) -> list[Reason]:
    """The worst reason of every camera, and others up to ``LEAST`` in all; in their order."""
    first = {name: at for at, reason in reversed([*enumerate(reasons)]) for name in reason.cameras}
    chosen = dict.fromkeys([*first.values(), *range(len(reasons))])
    most = max(LEAST, len({*first.values()}))
    return [reasons[at] for at in sorted([*chosen][:most])]


def _actions(reasons: Sequence[Reason], verdicts: Mapping[str, Verdict]) -> tuple[str, ...]:
    """What to do, each sentence once, with its cameras unless it is for all."""
    cameras: dict[str, dict[str, None]] = {}
    for reason in reasons:
        if reason.action:
            cameras.setdefault(reason.action, {}).update(dict.fromkeys(reason.cameras))
    return tuple(
        action if len(names) == len(verdicts) else f"{', '.join(names)}: {action}"
        for action, names in cameras.items()
    )


def _largest(sources: Mapping[str, ErrorSources], tolerance: tuple[float, float]) -> str:
    """The camera whose error bar is largest beside the tolerance; empty without any."""
    return max(sources, key=lambda name: sources[name].over_tolerance(tolerance), default="")


def _rank(reason: Reason) -> tuple[int, int]:
    """Worse ones first, then those that explain the others."""
    return _WORST_FIRST.index(reason.status), list(CAUSES).index(reason.cause)


def _unsure_first(reasons: Sequence[Reason]) -> list[Reason]:
    """Reasons about too little data before others, the first marked "cannot tell"."""
    first, *others = sorted(reasons, key=lambda reason: reason.cause not in _OF_DATA)
    return [replace(first, text=f"cannot tell: {first.text}"), *others]


def _unsure(verdicts: Mapping[str, Verdict]) -> list[Reason]:
    """The reasons that the error bar is too wide for the tolerance, with their cameras."""
    found: dict[tuple[Status, str], tuple[str, ...]] = {}
    for name, verdict in verdicts.items():
        one = verdict.error_probability
        if one is not None and one.of_error_bar:
            key = one.status, one.tolerated
            found[key] = (*found.get(key, ()), name)
    text = "the error bar is too wide for a tolerance of"
    return [Reason(of[0], names, f"{text} {of[1]}", "error bar") for of, names in found.items()]


def _error_probabilities(verdicts: Mapping[str, Verdict]) -> str:
    """The probabilities that cameras are off, the worst first, in one sentence."""
    found = {n: v.error_probability for n, v in verdicts.items() if v.error_probability}
    off = [(name, one) for name, one in found.items() if one.status != "PASS"]
    if not off:
        return ""
    off.sort(key=lambda item: (item[1].status, -item[1].probability))
    return f"{off[0][1].sentence}: {', '.join(f'{name} {one.percent}' for name, one in off)}"


def _findings(checks: Mapping[str, Sequence[Check]]) -> list[Reason]:
    """One reason per check, equal ones of several cameras together, the most severe first."""
    alike: dict[tuple[str, ...], dict[str, Check]] = {}
    for camera, of_camera in checks.items():
        for check in of_camera:
            key = (check.name, check.unit, "" if check.is_graded else _NUMBER.sub("", check.text))
            alike.setdefault(key, {})[camera] = check
    severest = sorted(alike.values(), key=lambda of: -max(check.severity for check in of.values()))
    return [_reason(each) for each in severest]


def _nearest(verdicts: Mapping[str, Verdict]) -> list[Reason]:
    """The check nearest its limit, of each camera that may be off though all its checks PASS."""
    reasons = []
    for name, verdict in verdicts.items():
        found = verdict.error_probability
        all_pass = all(check.status == "PASS" for check in verdict.checks)
        if found and found.status != "PASS" and not found.of_error_bar and all_pass:
            for check in sorted(verdict.checks, key=lambda check: -check.severity)[:1]:
                kind = check.kind or check.name
                text = f"no check is beyond its limit; nearest to it is {check.text}"
                cause, action = cause_of(kind), action_of(kind)
                reasons.append(Reason(verdict.status, (name,), text, cause, action, kind))
    return reasons


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
    meaning = first.text.removeprefix(f"{first.name}: ").partition(": ")[2]
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
