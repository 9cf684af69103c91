"""The table of thresholds in the documentation."""

from __future__ import annotations

from calibgraph.model.threshold import Threshold, in_unit, is_reachable
from calibgraph.model.verdict import TOLERANCE
from calibgraph.trust.thresholds import LIMITS, THRESHOLDS, Limit


def thresholds_markdown() -> str:
    """Both tables in Markdown, a line per row."""
    lines = [
        "| key | question | PASS | FAIL (else WARN) | reason, or the data it is from |",
        "|---|---|---|---|---|",
        *(_line(row) for row in THRESHOLDS),
        "",
        "\\* At the default tolerance of "
        f"{TOLERANCE[0]:g} deg and {TOLERANCE[1]:g} cm; another one scales the limit. A limit of "
        "FAIL, or in the table below, grows with the tolerance, and never falls below this value.",
        "",
        "| key | limit | meaning |",
        "|---|---|---|",
        *(_limit_line(row) for row in LIMITS),
    ]
    return "\n".join(lines) + "\n"


def _limit_line(row: Limit) -> str:
    scaled = " \\*" if row.of_tolerance else ""
    return f"| `{row.key}` | {in_unit(row.value, row.unit)}{scaled} | {row.meaning} |"


def _line(row: Threshold) -> str:
    beyond = "above" if row.direction == "at most" else "below"
    passes = f"{row.direction} {in_unit(row.warn, row.unit, digits=4)}"
    passes += " \\*" if row.of_tolerance else ""
    fails = "never"
    if is_reachable(row.fail, row.unit, row.direction):
        fails = f"{beyond} {in_unit(row.fail, row.unit, digits=4)}"
    cells = (f"`{row.key}`", row.question, passes, fails, row.reason)
    return f"| {' | '.join(cells)} |"
