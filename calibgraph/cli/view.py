"""The command view: a result for Rerun and Foxglove."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from calibgraph.cli.arguments import checked_arguments
from calibgraph.cli.terminal import print_plain, progress_bar, terminal


def view(
    result: Annotated[
        Path, typer.Argument(metavar="DIR", help="Result: its folder, or its calibration.yaml.")
    ],
    rerun: Annotated[
        Path | None,
        typer.Option(metavar="FILE.rrd", help="Recording for Rerun: `rerun FILE.rrd` shows it."),
    ] = None,
    mcap: Annotated[
        Path | None, typer.Option(metavar="FILE.mcap", help="Recording for Foxglove.")
    ] = None,
    dataset: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="DATASET",
            help="Where the images and clouds are now, if they have moved; repeat it for several "
            "folders, in the order in which they were calibrated.",
        ),
    ] = None,
) -> None:
    """Write a result for viewers: clouds, images and projected points, before and after."""
    from calibgraph.errors import CalibrationError
    from calibgraph.io.calibrations import load_calibration
    from calibgraph.io.dataset import load_dataset
    from calibgraph.report import relocate_frames
    from calibgraph.view.mcap_file import write_mcap
    from calibgraph.view.rerun_file import write_rerun

    if rerun is None and mcap is None:
        raise CalibrationError("nothing to write; give --rerun FILE.rrd, --mcap FILE.mcap or both")
    loaded = load_calibration(result)
    if dataset:
        with checked_arguments():
            loaded = relocate_frames(loaded, load_dataset(dataset, loaded.rig))
    os.environ.setdefault("RUST_LOG", "off")  # Rerun logs what our line states
    written = []
    with progress_bar("reading") as progress:
        if rerun is not None:
            written.append(write_rerun(loaded, rerun, progress=progress))
        if mcap is not None:
            written.append(write_mcap(loaded, mcap, progress=progress))
    for path in written:
        print_plain(terminal(), f"{path}: written; the verdict is {loaded.verdict.status}")
