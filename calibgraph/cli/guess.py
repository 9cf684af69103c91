"""The commands for a rig to begin with: guess, from words, files or nothing; init, to fill in."""

from pathlib import Path
from typing import Annotated

import typer

from calibgraph.cli import exchange
from calibgraph.cli.arguments import checked_arguments
from calibgraph.cli.exchange import parse_names
from calibgraph.cli.options import JsonOption, SeedOption
from calibgraph.cli.terminal import print_json, print_plain, progress_bar, terminal

MountOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=WORDS",
        help="How a camera is mounted: front, front-left, left, rear-left, rear, ...; then "
        "NUMBER deg left|right|up|down|clockwise|counterclockwise from there, upside down, "
        "NUMBER m|cm ahead|behind|left|right|above|below of the LiDAR. May be repeated.",
    ),
]
ForwardOption = Annotated[
    str,
    typer.Option(metavar="+x|-x|+y|-y", help="Axis of the LiDAR frame that points ahead; z is up."),
]


def guess(
    files: exchange.FilesArgument,
    out: Annotated[Path, typer.Option(metavar="FILE.yaml", help="Rig file to write.")],
    mount: MountOption = None,
    dataset: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="DATASET",
            help="Images and clouds: cameras without words or an extrinsic in a file are searched "
            "for over all headings. Slower, and less sure. May be repeated.",
        ),
    ] = None,
    search: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME", help="Search for this camera although a file has an extrinsic."
        ),
    ] = None,
    forward: ForwardOption = "+x",
    rename: exchange.RenameOption = None,
    lidar_frame: exchange.LidarFrameOption = None,
    camera_frame: exchange.CameraFrameOption = None,
    size: exchange.SizeOption = None,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Write a rig to begin a calibration with, by words, a URDF or a search, and how good it is."""
    from calibgraph.guessing.guess import guess_rig
    from calibgraph.io.formats.rig_import import read_rig_parts
    from calibgraph.outputs import yaml_mark

    named = [exchange.parse_file(text) for text in files]
    with checked_arguments(), progress_bar("reading") as progress:
        parts = read_rig_parts(
            [path for _, path in named],
            names={path: name for name, path in named if name},
            rename=exchange.parse_names("--rename", rename),
            lidar_frame=lidar_frame,
            camera_frames=exchange.parse_names("--camera-frame", camera_frame),
        )
        found = guess_rig(
            parts,
            mountings=exchange.parse_names("--mount", mount),
            data=dataset or None,
            search=search or (),
            forward=forward,
            size_px=None if size is None else exchange.parse_size(size),
            seed=seed,
            progress=progress,
        )
    found.save(out, first_line=yaml_mark("guess"))
    if as_json:
        print_json(found.to_mapping())
    exchange.print_doubts(found.rig, parts.notes)
    for line in found.lines:
        print_plain(terminal(), line)
    print_plain(terminal(), f"{out}: written; check the sentences above against the vehicle")


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
