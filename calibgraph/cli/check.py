"""The command that audits a deployed calibration: check."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from calibgraph.cli import remote
from calibgraph.cli.arguments import checked_arguments, dataset_from, matcher_from
from calibgraph.cli.options import DatasetArgument, FramesOption, JsonOption, SeedOption
from calibgraph.cli.terminal import print_json, progress_bar, terminal

_EXIT_CODES = {"OK": 0, "WRONG": 1, "CANNOT TELL": 3}


def check(
    rig: Annotated[
        Path, typer.Argument(metavar="RIG", help="The deployed calibration: a result or a rig.")
    ],
    dataset: DatasetArgument,
    tolerance_deg: Annotated[
        float, typer.Option(metavar="DEG", help="Largest deviation about an axis that is OK.")
    ] = 0.5,
    tolerance_cm: Annotated[
        float, typer.Option(metavar="CM", help="Largest deviation along an axis that is OK.")
    ] = 10.0,
    frames: FramesOption = None,
    seed: SeedOption = 0,
    page: Annotated[
        Path | None,
        typer.Option(metavar="FILE.html", help="Show the answer on a page, with pictures."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Is a deployed calibration still right? Exit 0: all OK, 1: WRONG, 3: the data cannot tell.

    Compares it with images and clouds of a recent recording, per camera and axis. Writes no file
    but the page, if one is wanted.
    """
    from calibgraph.audit import check
    from calibgraph.audit.provenance import is_made_from
    from calibgraph.audit.result import audit_of
    from calibgraph.audit.significance import Tolerance
    from calibgraph.io.rigs import load_rig

    with checked_arguments():
        Tolerance(tolerance_deg, tolerance_cm)
        matcher = matcher_from("structure", None, seed=seed, all_frames=frames is not None)
    data, deployed = dataset_from(dataset, rig, frames), load_rig(rig)
    if remote.SERVER.get() is not None:
        wanted = {"tolerance_deg": tolerance_deg, "tolerance_cm": tolerance_cm, "seed": seed}
        audit = audit_of(remote.check(rig, data, frames, wanted)).of_recording(deployed, data)
    else:
        with progress_bar() as progress:
            audit = check(
                deployed,
                data,
                tolerance_deg=tolerance_deg,
                tolerance_cm=tolerance_cm,
                matcher=matcher,
                seed=seed,
                progress=progress,
            )
    audit = replace(audit, same_recording=is_made_from(rig, data))
    if page is not None:
        from calibgraph.audit.page import write_audit_report

        write_audit_report(audit, page)
    if as_json:
        from calibgraph.audit import audit_summary

        print_json(audit_summary(audit))
    else:
        from calibgraph.cli.audit_tables import print_audit

        print_audit(terminal(), audit, page)
    raise typer.Exit(_EXIT_CODES[audit.status])
