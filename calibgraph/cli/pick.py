"""The command that opens a page to pick a reference on: pick."""

import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from calibgraph.cli.arguments import dataset_from, require_service
from calibgraph.cli.options import DatasetArgument, FramesOption, RigOption
from calibgraph.cli.terminal import print_plain, terminal

PORT = 8765


def pick(
    dataset: DatasetArgument,
    out: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            help="Folder of the session, which is continued if it is there, and of what it gives: "
            "reference.yaml and picked.parquet.",
        ),
    ],
    rig: RigOption = None,
    frames: FramesOption = None,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Of this machine; 0 for any that is free.")
    ] = PORT,
    show: Annotated[
        bool, typer.Option("--show/--no-show", help="Open the page in the browser.")
    ] = True,
) -> None:
    """Pick a reference by hand: a page on which pixels and LiDAR points are paired.

    The server answers this machine only. Ends with Ctrl-C; every change is saved at once.
    """
    require_service()
    from calibgraph.files import require_place_for_folder
    from calibgraph.service.pick.app import loopback_socket, pick_server
    from calibgraph.service.pick.workspace import Workspace

    require_place_for_folder(out)
    workspace = Workspace(dataset_from(dataset, rig, frames), out)
    with loopback_socket(port) as listening:
        address = f"http://127.0.0.1:{listening.getsockname()[1]}/pick"
        print_plain(terminal(), f"{address}: pick there; end with Ctrl-C")
        if show:
            webbrowser.open(address)
        pick_server(workspace).run(sockets=[listening])
