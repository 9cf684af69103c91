"""The commands for many vehicles: fleet, fleet-model, fleet-report."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import typer
from typer import Argument, Option

from calibgraph.cli.options import JsonOption
from calibgraph.cli.terminal import print_json, print_plain, progress_bar, terminal

if TYPE_CHECKING:
    from calibgraph.fleet.model import FleetModel
    from calibgraph.fleet.run import Summary
    from calibgraph.model.rig import Rig


def fleet(
    manifest: str = Argument(
        ...,
        metavar="MANIFEST",
        help="Table of the vehicles: .parquet, .csv or .yaml, a path or URI. Columns: vehicle, "
        "recording (folders, or a table of correspondences), rig, settings.",
    ),
    out: str = Option("fleet", metavar="URI", help="Folder or URI for the rows."),
    engine: str = Option(
        "processes",
        metavar="NAME[:ADDRESS]",
        help="Where jobs run: processes (here), ray, ray:ADDRESS, dask or dask:ADDRESS.",
    ),
    jobs: int | None = Option(None, min=1, help="Jobs at once. (default: one per core)"),
    shard: str | None = Option(
        None,
        metavar="I/N",
        help="Only part I of N, from 0; needed in an array of jobs. (default: all)",
    ),
    timeout_s: float = Option(3600.0, min=0.001, metavar="SECONDS", help="Longest time of a job."),
    memory_gb: float | None = Option(
        None, min=0.1, metavar="GB", help="Most memory of a job. (default: no limit)"
    ),
    fetch_gb: float = Option(50.0, min=0.0, metavar="GB", help="Most bytes of a remote recording."),
    allow_missing: bool = Option(
        False, "--allow-missing", help="Missing recordings become failed rows."
    ),
    logs: bool = Option(True, "--logs/--no-logs", help="Keep a log per vehicle below URI/_logs."),
    as_json: JsonOption = False,
) -> None:
    """Calibrate many vehicles, each alone: a row per camera. What is finished is not done again.

    Exit 1 if a job failed or a camera's verdict is FAIL. Ctrl-C, a crash or a lost machine loses no
    published row: the same command goes on from there.
    """
    import os

    from calibgraph.fleet.run import run_fleet, shard_from
    from calibgraph.fleet.task import Limits

    part = shard_from(shard, os.environ)
    memory_bytes = None if memory_gb is None else int(memory_gb * 1e9)
    limits = Limits(timeout_s=timeout_s, memory_bytes=memory_bytes, fetch_bytes=fetch_gb * 1e9)
    with _interrupt_on_sigterm(), progress_bar() as progress:
        summary = run_fleet(
            manifest,
            out,
            engine=engine,
            slots=jobs,
            shard=part,
            limits=limits,
            allow_missing=allow_missing,
            logs=logs,
            progress=progress,
        )
    _print(summary, out, as_json=as_json)
    if summary.failures or "FAIL" in summary.verdicts:
        raise typer.Exit(1)


@contextmanager
def _interrupt_on_sigterm() -> Iterator[None]:
    """End as on Ctrl-C when a scheduler stops this process: what is done is published."""
    import signal

    def interrupt(*_: Any) -> NoReturn:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _print(summary: Summary, out: str, *, as_json: bool) -> None:
    if as_json:
        print_json({"out": out, **asdict(summary)})
        return
    counts = [f"{summary.verdicts.get(name, 0)} {name}" for name in ("PASS", "WARN", "FAIL")]
    print_plain(
        terminal(),
        f"{out}: {summary.jobs} jobs, {summary.skipped} finished before; cameras: "
        + ", ".join(counts),
    )
    for kind, count in summary.failures.items():
        print_plain(terminal(), f"failed: {count} ({kind}); see the column error, and _logs")


def fleet_report(
    rows: str = Argument(
        ..., metavar="URI", help="What calibgraph fleet wrote: a folder or a URI."
    ),
    out: Path = Option(Path("fleet.html"), metavar="PAGE", help="Page to write, .html."),
    before: str | None = Option(
        None,
        metavar="URI",
        help="Earlier rows to compare with. (default: those of a week before the newest)",
    ),
    link: str = Option(
        "", metavar="TEMPLATE", help="Of a vehicle's own report: vehicles/{vehicle}/report.html"
    ),
) -> None:
    """One page for a whole fleet: which cameras deviate, what changed, how poses are spread."""
    from calibgraph.files import require_place_for_file
    from calibgraph.fleet.page import write_fleet_report
    from calibgraph.fleet.rows import read_rows

    require_place_for_file(out, ".html", ".htm")
    earlier = None if before is None else read_rows(before)
    _print_fleet(write_fleet_report(read_rows(rows), out, before=earlier, link=link))
    print_plain(terminal(), f"wrote {out}")


def fleet_model(
    rows: str = Argument(
        ..., metavar="URI", help="What calibgraph fleet wrote: a folder or a URI."
    ),
    out: Path = Option(Path("fleet_model"), metavar="DIR", help="Folder to write."),
    rig: list[str] | None = Option(
        None,
        metavar="[MODEL=]RIG",
        help="A rig of a model of vehicle, for its lenses: a prior for its next vehicle is "
        "written. Repeat it for further models.",
    ),
) -> None:
    """What a fleet knows: nominal rigs with spreads, improved estimates, priors for new vehicles.

    Writes fleet_model.json, estimates.parquet and, with --rig, prior_MODEL.yaml and one per batch.
    """
    from calibgraph.file_sets import require_own_folder
    from calibgraph.fleet.model import fit_fleet
    from calibgraph.fleet.model_files import write_fleet_model
    from calibgraph.fleet.observations import newest_rows, observe
    from calibgraph.fleet.rows import read_rows

    require_own_folder(out)
    fleet = fit_fleet(observe(newest_rows(read_rows(rows))))
    written = write_fleet_model(fleet, out, _rigs(rig or [], fleet))
    _print_fleet(fleet)
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


def _print_fleet(fleet: FleetModel) -> None:
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
