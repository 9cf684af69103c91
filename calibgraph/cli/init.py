"""The command init: a rig file to fill in."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calibgraph.cli.arguments import checked_arguments
from calibgraph.cli.exchange import parse_names
from calibgraph.cli.guess import ForwardOption, MountOption
from calibgraph.cli.terminal import print_plain, terminal


def init(
    dataset: Annotated[
        Path, typer.Argument(metavar="DATASET", help="Folder with lidar/ and cameras/NAME/.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE.yaml", help="Rig file to write. (default: DATASET/rig.yaml)"),
    ] = None,
    mount: MountOption = None,
    forward: ForwardOption = "+x",
    force: Annotated[
        bool,
        typer.Option("--force", help="Replace the file, and the values in it."),
    ] = False,
) -> None:
    """Write a rig.yaml to fill in: the cameras and image sizes of a folder, each key explained."""
    from calibgraph.guessing.template import write_rig_template
    from calibgraph.outputs import require_outside_dataset

    if out is not None:
        require_outside_dataset(out, [dataset])
    with checked_arguments():
        words = parse_names("--mount", mount)
        path = write_rig_template(dataset, out, mountings=words, forward=forward, replace=force)
    print_plain(terminal(), f"{path}: written; replace every FILL_IN, then run calibgraph doctor")
