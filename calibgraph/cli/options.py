"""Options and arguments that several commands share."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

_BAGS, _STRUCTURE = "ROS bags", "Matcher structure"
_MOST_SEED = 2**31 - 1


def require_stdout(as_json: bool) -> bool:
    """Refuse ``--json`` to a closed stdout before the work, not after it."""
    if as_json:
        from calibgraph.report.as_json import require_stdout

        require_stdout()
    return as_json


Datasets = Annotated[
    list[Path],
    Argument(
        metavar="DATASET...",
        help="Dataset folder (rig.yaml, lidar/, cameras/NAME/), KITTI odometry sequence or raw "
        "drive, nuScenes folder or scene, or ROS bag; several of one rig are calibrated together.",
    ),
]
RigFile = Annotated[
    Path | None, Option(metavar="RIG", help="Initial guess, instead of the dataset's own.")
]
Frames = Annotated[
    str | None,
    Option(
        metavar="A:B:STEP",
        help="Which frames, by position from 0 among the sorted names: 0:90:10 or 0,5,7. (default: "
        "all; of more than 30 the matcher structure takes 30: spread, clear ones)",
    ),
]
_EVERY = "One frame in this time; only its surroundings are read. (default: all frames)"
EveryS = Annotated[
    float | None, Option(metavar="SECONDS", min=0.001, rich_help_panel=_BAGS, help=_EVERY)
]
Topic = Annotated[
    list[str] | None,
    Option(
        metavar="NAME=/TOPIC[,/INFO]",
        rich_help_panel=_BAGS,
        help="Topic of a camera's images, of the clouds as lidar=/TOPIC, or of odometry=/TOPIC; "
        "INFO: of the camera_info. May be repeated. (default: found by types)",
    ),
]
Motion = Annotated[
    str | None,
    Option(
        metavar="none|odometry|tf|scans",
        rich_help_panel=_BAGS,
        help="Correct clouds for the motion of the vehicle, to the stamps of the images: by "
        "Odometry, /tf, or registration of neighbouring scans. (default: none)",
    ),
]
IntervalS = Annotated[
    float | None,
    Option(
        metavar="SECONDS",
        help="Time between neighbouring clouds of a folder: the motion of the LiDAR is found by "
        "their registration. For --estimate offset or readout. (default: unknown)",
    ),
]
MatcherName = Annotated[
    str, Option(metavar="NAME|FILE", help="structure, cmrnext, or a table of correspondences.")
]
_WEIGHTS = "Networks of cmrnext, .tar or .safetensors; repeat it in the order in which they run."
Weights = Annotated[list[Path] | None, Option(metavar="FILE", help=_WEIGHTS)]
TimeLimitS = Annotated[
    float | None,
    Option(
        metavar="SECONDS",
        min=0.001,
        help="Stop matching after this time; a result of fewer rounds is marked as partial. "
        "(default: 1800 with structure, else none; inf for none)",
    ),
]
SearchDeg = Annotated[
    float | None,
    Option(
        metavar="DEG",
        min=0,
        rich_help_panel=_STRUCTURE,
        help="Largest rotation error of the guess, per axis; 0: no search, for a guess within "
        "about 2.5 deg and 25 cm. The guess itself is tried first. (default: 20)",
    ),
]
_SEARCH_M = "Largest translation error of the guess, per axis. (default: 1.5)"
SearchM = Annotated[
    float | None, Option(metavar="M", min=0, rich_help_panel=_STRUCTURE, help=_SEARCH_M)
]
ConfigFile = Annotated[
    Path | None,
    Option(metavar="FILE", help="Settings of the solve, and rare ones of the rest, YAML."),
]
_OF_READING = "YAML with stamps or sync_tolerance_s; its other settings change nothing here."
ReadingFile = Annotated[
    Path | None, Option("--config", metavar="FILE", rich_help_panel=_BAGS, help=_OF_READING)
]
Estimate = Annotated[
    str | None,
    Option(
        metavar="PART,...",
        help="Estimate each camera's lens and clock too: focal, centre, distortion, or lens for "
        "all; offset, readout, or clock for both.",
    ),
]
Of = Annotated[
    str | None,
    Option(
        metavar="alignment|mount",
        help="Poses to report. alignment: for projecting points. mount: the physical pose, with a "
        "wider error bar. (default: alignment)",
    ),
]
ResultFolder = Annotated[
    Path,
    Option(metavar="DIR", help="Folder for the result; that of an older result is written again."),
]
Seed = Annotated[int, Option(min=0, max=_MOST_SEED, help="Seed of everything random.")]
_SEED = "Seed of everything random. (default: that of --config, else 0)"
SeedOrConfig = Annotated[int | None, Option(min=0, max=_MOST_SEED, help=_SEED)]
ToleranceDeg = Annotated[
    float, Option(metavar="DEG", help="Largest deviation about an axis that is OK.")
]
ToleranceCm = Annotated[
    float, Option(metavar="CM", help="Largest deviation along an axis that is OK.")
]
JsonOption = Annotated[
    bool, Option("--json", callback=require_stdout, help="Print JSON on stdout.")
]
Force = Annotated[bool, Option("--force", help="Replace a file that is there.")]
