"""The command that makes a reference by hand."""

import webbrowser
from pathlib import Path

from typer import Option

from calibgraph.cli import options
from calibgraph.cli.arguments import dataset_from
from calibgraph.cli.terminal import print_plain, terminal
from calibgraph.errors import CalibrationError


def pick(
    dataset: options.Datasets,
    out: Path = Option(
        ...,
        metavar="DIR",
        help="Folder of the session, which is continued if it is there, and of what it gives: "
        "reference.yaml and picked.parquet.",
    ),
    rig: options.RigFile = None,
    frames: options.Frames = None,
    port: int = Option(0, min=0, max=65535, help="Of this machine. (default: any that is free)"),
    show: bool = Option(True, "--show/--no-show", help="Open the page in the browser."),
) -> None:
    """Pick a reference by hand: a page on which pixels and LiDAR points are paired.

    The server answers this machine only. Ends with Ctrl-C; every change is saved at once.
    """
    from calibgraph.file_sets import require_own_folder
    from calibgraph.pick.server import PickServer
    from calibgraph.pick.workspace import Workspace

    require_own_folder(out, dataset)
    workspace = Workspace(dataset_from(dataset, rig, frames), out)
    try:
        server = PickServer(workspace, port)
    except OSError as error:
        raise CalibrationError(
            f"--port {port}: cannot be used ({error.strerror}); leave it out for a free one"
        ) from error
    with server:
        print_plain(terminal(), f"{server.url}: pick there; end with Ctrl-C")
        if show:
            webbrowser.open(server.url)
        server.serve_forever()
