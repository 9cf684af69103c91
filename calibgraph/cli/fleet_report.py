"""The commands of a whole fleet's results: fleet-model, fleet-report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibgraph.cli.terminal import print_plain, terminal

if TYPE_CHECKING:
    from calibgraph.fleet.model import FleetModel
    from calibgraph.model.rig import Rig

RowsArgument = Annotated[
    str, typer.Argument(metavar="URI", help="What calibgraph fleet wrote: a folder or a URI.")
]


def fleet_report(
    rows: RowsArgument,
    out: Annotated[Path, typer.Option(metavar="PAGE", help="Page to write, .html.")] = Path(
        "fleet.html"
    ),
    before: Annotated[
        str | None,
        typer.Option(
            metavar="URI",
            help="Earlier rows to compare with. (default: those of a week before the newest)",
        ),
    ] = None,
    link: Annotated[
        str,
        typer.Option(
            metavar="TEMPLATE", help="Of a vehicle's own report: vehicles/{vehicle}/report.html"
        ),
    ] = "",
) -> None:
    """One page for a whole fleet: which cameras deviate, what changed, how poses are spread."""
    from calibgraph.fleet.page import write_fleet_report
    from calibgraph.fleet.rows import read_rows

    earlier = None if before is None else read_rows(before)
    _print(write_fleet_report(read_rows(rows), out, before=earlier, link=link))
    print_plain(terminal(), f"wrote {out}")


def fleet_model(
    rows: RowsArgument,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write.")] = Path(
        "fleet_model"
    ),
    rig: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[MODEL=]RIG",
            help="A rig of a model of vehicle, for its lenses: a prior for its next vehicle is "
            "written. Repeat it for further models.",
        ),
    ] = None,
) -> None:
    """What a fleet knows: nominal rigs with spreads, improved estimates, priors for new vehicles.

    Writes fleet_model.json, estimates.parquet and, with --rig, prior_MODEL.yaml and one per batch.
    """
    from calibgraph.fleet.model import fit_fleet
    from calibgraph.fleet.model_files import write_fleet_model
    from calibgraph.fleet.observations import newest_rows, observe
    from calibgraph.fleet.rows import read_rows

    fleet = fit_fleet(observe(newest_rows(read_rows(rows))))
    written = write_fleet_model(fleet, out, _rigs(rig or [], fleet))
    _print(fleet)
    print_plain(terminal(), f"wrote {', '.join(str(path) for path in written[:2])}"
                + (f" and {len(written) - 2} priors" if len(written) > 2 else ""))  # noqa: PLR2004  # fmt: skip


def _rigs(given: list[str], fleet: FleetModel) -> dict[str, Rig]:
    """Per model of vehicle, the rig that is given for it."""
    from calibgraph.errors import CalibrationError
    from calibgraph.io.rigs import load_rig

    rigs = {}
    for text in given:
        name, equals, path = text.rpartition("=")
        if not equals and len(fleet.models) == 1:
            name = next(iter(fleet.models))
        if name not in fleet.models:
            raise CalibrationError(
                f"--rig {text}: no model {name!r} with enough measured vehicles, found "
                f"{', '.join(map(repr, fleet.models)) or 'none'}; write MODEL=RIG"
            )
        rigs[name] = load_rig(Path(path))
    return rigs


def _print(fleet: FleetModel) -> None:
    """A line per finding, and how many vehicles there are."""
    from calibgraph.fleet.findings import find_changes, moved_lidars

    of = fleet.observations
    apart = sorted({*of.vehicle[fleet.apart].tolist()})
    print_plain(
        terminal(),
        f"{len({*of.vehicle.tolist()})} vehicles, {int(of.measured.sum())} cameras measured; "
        f"{int(fleet.apart.sum())} cameras of {len(apart)} vehicles stand apart",
    )
    for finding in find_changes(fleet):
        print_plain(terminal(), finding.text)
    for vehicle in moved_lidars(fleet):
        print_plain(terminal(), f"{vehicle}: all cameras moved alike: the LiDAR was moved")
