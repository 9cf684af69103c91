"""The command doctor: what to fix in a dataset before it is calibrated."""

from pathlib import Path
from typing import Annotated

import typer

from calibgraph.cli import options
from calibgraph.cli.arguments import bag_options_from, checked_arguments
from calibgraph.cli.terminal import print_json, print_plain, progress_bar, terminal


def doctor(
    dataset: options.DatasetArgument,
    rig: options.RigOption = None,
    frames: options.FramesOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder for guess_CAMERA.png: the guess on an image of each camera."
        ),
    ] = None,
    topic: options.TopicOption = None,
    every_s: options.EverySecondsOption = None,
    tolerance_s: options.ToleranceOption = None,
    stamps: options.StampsOption = None,
    motion: options.MotionOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Examine a dataset before it is calibrated: what is there, what to fix; exit 1 if anything."""
    from calibgraph.doctor import diagnose
    from calibgraph.files import require_place_for_folder
    from calibgraph.io.rigs import load_rig
    from calibgraph.outputs import require_outside_dataset

    if out is not None:
        require_place_for_folder(out)
        require_outside_dataset(out, dataset)
    bag = bag_options_from(
        topic, every_s=every_s, tolerance_s=tolerance_s, stamps=stamps, motion=motion
    )
    with checked_arguments(), progress_bar("reading"):
        guess = load_rig(rig) if rig else None
        found = diagnose(dataset, guess, frames=frames, bag=bag, pictures=out)
    if as_json:
        print_json(found.to_mapping())
    else:
        for finding in found.findings:
            print_plain(terminal(), f"{finding.level:8} {finding.text}")
        for path in found.pictures:
            print_plain(terminal(), f"{path}: written")
        if all(finding.level == "note" for finding in found.findings):
            print_plain(terminal(), "nothing to mend; next: calibgraph calibrate")
    if not found.healthy:
        raise typer.Exit(1)
