"""Options that several commands share.

Args:
    as_json: Print JSON on stdout.
    config (FILE): Settings of the solve, YAML.
    correct ([CAMERA=]MISTAKE): Undo a mistake of the guess, by the name that doctor gives it, as
        inverse or camera-flu; of all cameras or of one. May be repeated.
    dataset (DATASET...): Dataset folder (rig.yaml, lidar/, cameras/NAME/), KITTI odometry sequence
        or raw drive, nuScenes folder or scene, or ROS bag; several of one rig are calibrated
        together.
    device (auto|cpu|cuda): Torch device. (default: auto)
    forward (+x|-x|+y|-y): Axis of the LiDAR frame that points ahead; z is up.
    frames (A:B:STEP): Which frames, by position from 0 among the sorted names: 0:90:10 or 0,5,7.
        (default: all; of more than 30 the matcher structure takes 30: spread, clear ones)
    motion (none|odometry|tf|scans): Correct clouds for the motion of the vehicle, to the stamps of
        the images: by Odometry, /tf, or registration of neighbouring scans. (default: none)
    mount (NAME=WORDS): How a camera is mounted: front, front-left, left, rear-left, rear, ...; then
        NUMBER deg left|right|up|down|clockwise|counterclockwise from there, upside down, NUMBER
        m|cm ahead|behind|left|right|above|below of the LiDAR. May be repeated.
    out (DIR): Folder for the result.
    preset (auto|kitti|walkley): Settings of the solve by name.
    result (DIR): Result: its folder, or its calibration.yaml.
    rig (RIG): Initial guess, instead of the dataset's own.
    seed: Seed of everything random.
    tolerance_cm (CM): Largest deviation along an axis that is OK.
    tolerance_deg (DEG): Largest deviation about an axis that is OK.
    topic (NAME=/TOPIC[,/INFO]): Topic of a camera's images, of the clouds as lidar=/TOPIC, or of
        odometry=/TOPIC; INFO: of the camera_info. May be repeated. (default: found by types)
    weights (FILE...): Weights of the networks, .tar or .safetensors, in the order in which they
        run; a file may be repeated: --weights iter1.tar iter5.tar iter5.tar iter6.tar.
"""

from pathlib import Path
from typing import Annotated

import typer

CMRNEXT, BAGS = "Matcher cmrnext", "ROS bags"
_MAX_SEED = 2**31 - 1
WeightsOption = Annotated[list[Path] | None, typer.Option(rich_help_panel=CMRNEXT)]
DeviceOption = Annotated[str | None, typer.Option(rich_help_panel=CMRNEXT)]
TopicOption = Annotated[list[str] | None, typer.Option(rich_help_panel=BAGS)]
MotionOption = Annotated[str | None, typer.Option(rich_help_panel=BAGS)]
SeedOption = Annotated[int, typer.Option(min=0, max=_MAX_SEED)]
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


JsonOption = Annotated[bool, typer.Option("--json", callback=require_stdout)]
