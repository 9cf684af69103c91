"""The table of thresholds in the documentation."""

from calibgraph.model.verdict import TOLERANCE, Threshold, in_unit, is_reachable
from calibgraph.trust.thresholds import THRESHOLDS


def thresholds_markdown() -> str:
    """The table in Markdown; a check of a rotation and that of the translation share a line."""
    rows: dict[str, list[Threshold]] = {}
    for row in THRESHOLDS:
        subject = row.key.removesuffix("_rotation").removesuffix("_translation")
        rows.setdefault(subject, []).append(row)
    return "\n".join(
        [
            "| `kind` | question | PASS | FAIL, else WARN |",
            "|---|---|---|---|",
            *(_line(pair) for pair in rows.values()),
            "",
            "\\* At the default tolerance of "
            f"{TOLERANCE[0]:g} deg and {TOLERANCE[1]:g} cm; another one scales the limit. A limit "
            "of FAIL grows with the tolerance, and never falls below this value.",
        ]
    )


def _line(rows: list[Threshold]) -> str:
    keys = [row.key for row in rows]
    keys[1:] = [key.removeprefix(keys[0].rpartition("_")[0]) for key in keys[1:]]
    cells = ("`, `".join(keys), rows[0].question, _passes(rows), _fails(rows))
    return "| `{}` | {} | {} | {} |".format(*cells)


def _passes(rows: list[Threshold]) -> str:
    limits = ", ".join(in_unit(row.warn, row.unit, digits=4) for row in rows)
    sign = "≤" if rows[0].warn <= rows[0].fail else "≥"
    return f"{sign} {limits}" + (" \\*" if rows[0].of_tolerance else "")


def _fails(rows: list[Threshold]) -> str:
    sign = ">" if rows[0].warn <= rows[0].fail else "<"
    if not all(is_reachable(row.fail, row.unit, sign) for row in rows):
        return "never"
    return f"{sign} {', '.join(in_unit(row.fail, row.unit, digits=4) for row in rows)}"
