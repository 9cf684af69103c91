"""The command that compares results with each other: drift."""

from datetime import date
from pathlib import Path
from typing import Annotated

import typer

from calibgraph.cli.arguments import checked_arguments
from calibgraph.cli.options import JsonOption
from calibgraph.cli.terminal import print_json, print_plain, terminal

_EXIT_CODES = {"OK": 0, "CHANGED": 1, "CANNOT TELL": 3}


def drift(
    results: Annotated[
        list[Path],
        typer.Argument(
            metavar="RESULT...",
            help="Results of one rig: their folders, or calibration.yaml files.",
        ),
    ],
    days: Annotated[
        str | None,
        typer.Option(
            metavar="DAY,DAY,...",
            help="When each was recorded, for the trend: dates like 2026-03-01, or numbers of "
            "days. (default: the order given)",
        ),
    ] = None,
    tolerance_deg: Annotated[
        float, typer.Option(metavar="DEG", help="Largest deviation about an axis that is OK.")
    ] = 0.5,
    tolerance_cm: Annotated[
        float, typer.Option(metavar="CM", help="Largest deviation along an axis that is OK.")
    ] = 10.0,
    own_lenses: Annotated[
        bool,
        typer.Option(
            "--own-lenses", help="Lenses may differ: several vehicles, each with its own."
        ),
    ] = False,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Draw the deviations, per camera.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Which of several results of one rig deviates? Exit 0: none, 1: one CHANGED, 3: cannot tell.

    Compares each result with the others that agree, per camera and axis, without a reference: of
    several days, or of several vehicles. One false alarm in 100 calls.
    """
    from calibgraph.audit import drift

    with checked_arguments():
        found = drift(
            results,
            days=None if days is None else _parse_days(days),
            tolerance_deg=tolerance_deg,
            tolerance_cm=tolerance_cm,
            own_lenses=own_lenses,
        )
    if plot is not None:
        from calibgraph.audit.drift_plot import draw_drift

        draw_drift(found, plot)
    if as_json:
        from calibgraph.audit import drift_summary

        print_json(drift_summary(found))
    else:
        from calibgraph.cli.audit_tables import print_drift

        print_drift(terminal(), found)
        print_plain(terminal(), f"{plot}: written" if plot is not None else "nothing was written")
    raise typer.Exit(_EXIT_CODES[found.status])


def _parse_days(text: str) -> list[float]:
    """Days of dates or numbers, separated by commas."""
    return [_parse_day(part.strip()) for part in text.split(",")]


def _parse_day(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        pass
    try:
        return float(date.fromisoformat(text).toordinal())
    except ValueError as error:
        raise ValueError(
            f"--days {text!r}: expected a date like 2026-03-01 or a number, for each result, "
            "separated by commas"
        ) from error
