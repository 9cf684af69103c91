"""The command for many vehicles: fleet."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from calibgraph.cli.options import JsonOption
from calibgraph.cli.terminal import print_json, print_plain, progress_bar, terminal

if TYPE_CHECKING:
    from calibgraph.fleet.run import Summary


def fleet(
    manifest: Annotated[
        str,
        typer.Argument(
            metavar="MANIFEST",
            help="Table of the vehicles: .parquet, .csv or .yaml, a path or URI. Columns: vehicle, "
            "recording (folders, or a table of correspondences), rig, settings.",
        ),
    ],
    out: Annotated[str, typer.Option(metavar="URI", help="Folder or URI for the rows.")] = "fleet",
    engine: Annotated[
        str,
        typer.Option(
            metavar="NAME[:ADDRESS]",
            help="Where jobs run: processes (here), ray, ray:ADDRESS, dask or dask:ADDRESS.",
        ),
    ] = "processes",
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Jobs at once. (default: one per core)")
    ] = None,
    shard: Annotated[
        str | None,
        typer.Option(
            metavar="I/N",
            help="Only part I of N, from 0; auto/N: the index of a Kubernetes, AWS Batch or Slurm "
            "array. (default: such an array's part, else all)",
        ),
    ] = None,
    timeout_s: Annotated[
        float, typer.Option(min=0.001, metavar="SECONDS", help="Longest time of a job.")
    ] = 3600.0,
    memory_gb: Annotated[
        float | None,
        typer.Option(min=0.1, metavar="GB", help="Most memory of a job. (default: no limit)"),
    ] = None,
    fetch_gb: Annotated[
        float, typer.Option(min=0.0, metavar="GB", help="Most bytes of a remote recording.")
    ] = 50.0,
    allow_missing: Annotated[
        bool, typer.Option("--allow-missing", help="Missing recordings become failed rows.")
    ] = False,
    logs: Annotated[
        bool, typer.Option("--logs/--no-logs", help="Keep a log per vehicle below URI/_logs.")
    ] = True,
    as_json: JsonOption = False,
) -> None:
    """Calibrate many vehicles, each alone: a row per camera. What is finished is not done again.

    Exit 1 if a job failed or a camera's verdict is FAIL. Ctrl-C, a crash or a lost machine loses no
    published row: the same command goes on from there.
    """
    import os

    from calibgraph.fleet.run import run_fleet
    from calibgraph.fleet.shards import shard_from
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
