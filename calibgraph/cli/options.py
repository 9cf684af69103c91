"""Arguments and options that commands share, and the options of the matchers."""

from pathlib import Path
from typing import Annotated

import typer

from calibgraph.cli import outputs

RigArgument = Annotated[Path, typer.Argument(metavar="RIG", help="Rig with the initial guess.")]
DatasetArgument = Annotated[
    list[Path],
    typer.Argument(
        metavar="DATASET...",
        help="Dataset folder (rig.yaml, lidar/, cameras/NAME/), KITTI odometry sequence or raw "
        "drive, nuScenes folder or scene, or ROS bag; several of one rig are calibrated together.",
    ),
]
RigOption = Annotated[
    Path | None, typer.Option(metavar="RIG", help="Initial guess, instead of the dataset's own.")
]
CMRNEXT = "Matcher cmrnext"
WeightsOption = Annotated[
    list[Path] | None,
    typer.Option(
        metavar="FILE...",
        help="Weights of the networks, .tar or .safetensors, in the order in which they run; a "
        "file may be repeated: --weights iter1.tar iter5.tar iter5.tar iter6.tar.",
        rich_help_panel=CMRNEXT,
    ),
]
DeviceOption = Annotated[
    str | None,
    typer.Option(
        metavar="auto|cpu|cuda", help="Torch device. (default: auto)", rich_help_panel=CMRNEXT
    ),
]
FramesOption = Annotated[
    str | None,
    typer.Option(
        metavar="A:B:STEP",
        help="Which frames, by position from 0 among the sorted names: 0:90:10 or 0,5,7. (default: "
        "all; of more than 30 the matcher structure takes 30: spread, clear ones)",
    ),
]
BAGS = "ROS bags"
TopicOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=/TOPIC",
        help="Topic of a camera's images, of the clouds as lidar=/TOPIC, or of odometry=/TOPIC; "
        "may be repeated. "
        "(default: found by the messages' types)",
        rich_help_panel=BAGS,
    ),
]
MotionOption = Annotated[
    str | None,
    typer.Option(
        metavar="none|odometry|tf|scans",
        help="Correct clouds for the motion of the vehicle, to the stamps of the images: by "
        "Odometry, /tf, or registration of neighbouring scans. (default: none)",
        rich_help_panel=BAGS,
    ),
]
ConfigOption = Annotated[
    Path | None, typer.Option("--config", metavar="FILE", help="Settings of the solve, YAML.")
]
PresetOption = Annotated[
    str | None,
    typer.Option(metavar="auto|kitti|walkley", help="Settings of the solve by name."),
]
OutOption = Annotated[
    Path, typer.Option(metavar="DIR", help="Folder for the result."), outputs.RESULT
]
_MAX_SEED = 2**31 - 1
SeedOption = Annotated[int, typer.Option(min=0, max=_MAX_SEED, help="Seed of everything random.")]
ConfigSeedOption = Annotated[
    int | None,
    typer.Option(
        min=0,
        max=_MAX_SEED,
        help="Seed of everything random. (default: that of --config, else 0)",
    ),
]


def require_stdout(as_json: bool) -> bool:
    """Refuse ``--json`` to a closed stdout before the work, not after it."""
    if as_json:
        from calibgraph.report.as_json import require_stdout

        require_stdout()
    return as_json


JsonOption = Annotated[
    bool, typer.Option("--json", callback=require_stdout, help="Print JSON on stdout.")
]
