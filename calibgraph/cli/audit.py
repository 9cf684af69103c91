"""The commands that compare calibrations with a recording, and with each other: check, drift."""

from pathlib import Path

import typer
from typer import Argument, Option

from calibgraph.cli import options
from calibgraph.cli.options import bag_settings, checked_arguments, dataset_from, matcher_from
from calibgraph.cli.terminal import elapsed_s, print_json, print_line, progress_bar, terminal

_EXIT_CODES = {"OK": 0, "WRONG": 1, "CHANGED": 1, "CANNOT TELL": 3}


def check(
    *,
    rig: Path = Argument(..., metavar="RIG", help="The deployed calibration: a result or a rig."),
    dataset: options.Datasets,
    tolerance_deg: options.ToleranceDeg = 0.5,
    tolerance_cm: options.ToleranceCm = 10.0,
    frames: options.Frames = None,
    topic: options.Topic = None,
    motion: options.Motion = None,
    config: options.ReadingFile = None,
    seed: options.Seed = 0,
    out: Path | None = Option(None, metavar="FILE.html", help="The answer as a page."),
    as_json: options.JsonOption = False,
    force: options.Force = False,
) -> None:
    """Is a deployed calibration still right? Exit 0: all OK, 1: WRONG, 3: the data cannot tell.

    Compares it with images and clouds of a recent recording, per camera, LiDAR and axis. Writes no
    file but the page, if one is wanted.
    """
    from calibgraph.audit import check
    from calibgraph.audit.judgement import tolerance_twist
    from calibgraph.files import require_new_file

    if out is not None:
        require_new_file(out, ".html", ".htm", force=force)
    with checked_arguments():
        tolerance_twist(tolerance_deg, tolerance_cm)
        matcher = matcher_from("structure", seed=seed, all_frames=frames is not None)
    data = dataset_from(dataset, rig, frames, bag_settings(config, topic, motion=motion))
    with progress_bar() as progress:
        audit = check(
            rig, data, tolerance_deg=tolerance_deg, tolerance_cm=tolerance_cm,
            matcher=matcher, seed=seed, progress=progress,
        )  # fmt: skip
    if out is not None:
        from calibgraph.audit.page import write_audit_report

        write_audit_report(audit, out)
    if as_json:
        from calibgraph.audit import audit_summary

        print_json(audit_summary(audit))
    else:
        from calibgraph.audit.page import print_audit

        print_audit(terminal(), audit, out, elapsed_s())
    raise typer.Exit(_EXIT_CODES[audit.status])


def drift(
    results: list[Path] = Argument(
        ..., metavar="RESULT...", help="Of one rig: their folders, or calibration.yaml files."
    ),
    tolerance_deg: options.ToleranceDeg = 0.5,
    tolerance_cm: options.ToleranceCm = 10.0,
    own_lenses: bool = Option(
        False, "--own-lenses", help="Lenses may differ: several vehicles, each with its own."
    ),
    as_json: options.JsonOption = False,
) -> None:
    """Which of several results of one rig deviates? Exit 0: none, 1: one CHANGED, 3: cannot tell.

    Compares each result with the others that agree, per camera, LiDAR and axis, without a
    reference: of several days, or of several vehicles. One false alarm in 100 calls.
    """
    from calibgraph.audit import drift

    with checked_arguments():
        sizes = {"tolerance_deg": tolerance_deg, "tolerance_cm": tolerance_cm}
        found = drift(results, **sizes, own_lenses=own_lenses)
    if as_json:
        from calibgraph.audit import drift_summary

        print_json(drift_summary(found))
    else:
        from calibgraph.audit.page import print_drift

        print_drift(terminal(), found)
        print_line("nothing was written")
    raise typer.Exit(_EXIT_CODES[found.status])
