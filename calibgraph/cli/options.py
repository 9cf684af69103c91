"""Arguments and options that commands share, and the options of the matchers."""

from pathlib import Path
from typing import Annotated

import typer

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
CameraMatchesOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Features that cameras have in common: camera_matches.parquet of a result.",
    ),
]
MatcherOption = Annotated[
    str,
    typer.Option(metavar="NAME|FILE", help="structure, cmrnext, or a table of correspondences."),
]
_STRUCTURE = "Matcher structure"
SearchDegOption = Annotated[
    str | None,
    typer.Option(
        metavar="DEG|none",
        help="Largest rotation error of the guess, per axis; none: no search, for a guess within "
        "about 2.5 deg and 25 cm. The guess itself is tried first. (default: 20)",
        rich_help_panel=_STRUCTURE,
    ),
]
SearchMetresOption = Annotated[
    str | None,
    typer.Option(
        "--search-m",
        metavar="M|none",
        help="Largest translation error of the guess, per axis; or none. (default: 1.5)",
        rich_help_panel=_STRUCTURE,
    ),
]
WindowWeightsOption = Annotated[
    str | None,
    typer.Option(
        metavar="FILE|none",
        help="Weights of windows of train-windows, in place of the package's; none: all windows "
        "count alike.",
        rich_help_panel=_STRUCTURE,
    ),
]
TimeLimitOption = Annotated[
    float | None,
    typer.Option(
        min=0.001,
        metavar="SECONDS",
        help="Stop matching after this time; a result of fewer rounds is marked as partial. "
        "[default: 1800 with structure, else none; inf for none]",
    ),
]
_CMRNEXT = "Matcher cmrnext"
WeightsOption = Annotated[
    list[Path] | None,
    typer.Option(
        metavar="FILE...",
        help="Weights of the networks, .tar or .safetensors, in the order in which they run; a "
        "file may be repeated: --weights iter1.tar iter5.tar iter5.tar iter6.tar.",
        rich_help_panel=_CMRNEXT,
    ),
]
StartFromOption = Annotated[
    str | None,
    typer.Option(
        metavar="frame|joint",
        help="Where a network starts: at each frame's own pose by the network before, or at the "
        "joint solve. (default: frame)",
        rich_help_panel=_CMRNEXT,
    ),
]
DeviceOption = Annotated[
    str | None,
    typer.Option(
        metavar="auto|cpu|cuda", help="Torch device. (default: auto)", rich_help_panel=_CMRNEXT
    ),
]
IterationsOption = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=1000,
        help="Iterations of each network's recurrent update (default: 12).",
        rich_help_panel=_CMRNEXT,
    ),
]
HalfOption = Annotated[
    bool | None,
    typer.Option(
        "--half-resolution/--full-resolution",
        help="Halve the images or not (default: as stored with the weights, else from 1400 px "
        "width on).",
        rich_help_panel=_CMRNEXT,
    ),
]
OcclusionOption = Annotated[
    bool | None,
    typer.Option(
        "--occlusion-filter",
        help="Leave out points that nearer surfaces occlude.",
        rich_help_panel=_CMRNEXT,
    ),
]
BatchOption = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Images per batch (default: 1 on a CPU, 4 on a GPU).",
        rich_help_panel=_CMRNEXT,
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
IntervalOption = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS",
        help="Time between neighbouring clouds of a folder: the motion of the LiDAR is found by "
        "their registration. For --estimate offset or readout. (default: unknown)",
    ),
]
_BAGS = "ROS bags"
TopicOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=/TOPIC",
        help="Topic of a camera's images, of the clouds as lidar=/TOPIC, or of odometry=/TOPIC; "
        "may be repeated. "
        "(default: found by the messages' types)",
        rich_help_panel=_BAGS,
    ),
]
EverySecondsOption = Annotated[
    float | None,
    typer.Option(
        min=0.001,
        metavar="SECONDS",
        help="One frame in this time; only its surroundings are read. (default: all frames)",
        rich_help_panel=_BAGS,
    ),
]
ToleranceOption = Annotated[
    float | None,
    typer.Option(
        min=0,
        metavar="SECONDS",
        help="Largest difference of the stamps of a cloud and its images. (default: 0.05)",
        rich_help_panel=_BAGS,
    ),
]
StampsOption = Annotated[
    str | None,
    typer.Option(
        metavar="header|record",
        help="Stamps of the sensors, or of recording. (default: header)",
        rich_help_panel=_BAGS,
    ),
]
MotionOption = Annotated[
    str | None,
    typer.Option(
        metavar="none|odometry|tf|scans",
        help="Correct clouds for the motion of the vehicle, to the stamps of the images: by "
        "Odometry, /tf, or registration of neighbouring scans. (default: none)",
        rich_help_panel=_BAGS,
    ),
]
ConfigOption = Annotated[
    Path | None, typer.Option("--config", metavar="FILE", help="Settings of the solve, YAML.")
]
PresetOption = Annotated[
    str | None,
    typer.Option(metavar="auto|kitti|walkley", help="Settings of the solve by name."),
]
OfOption = Annotated[
    str | None,
    typer.Option(
        "--of",
        metavar="alignment|mount",
        help="Poses to report: where the LiDAR's points meet the images, or where the sensors are "
        "mounted, less certain. (default: alignment)",
    ),
]
EstimateOption = Annotated[
    str | None,
    typer.Option(
        metavar="PART,...",
        help="Estimate each camera's lens and clock too: focal, aspect, centre, distortion, or "
        "lens for all but aspect; offset, readout, or clock for both. The rig may state how well "
        "they are known.",
    ),
]
TermsOption = Annotated[
    str,
    typer.Option(metavar="full|reprojection|priors|stage1", help="Terms of the objective."),
]
OutOption = Annotated[Path, typer.Option(metavar="DIR", help="Folder for the result.")]
BootstrapOption = Annotated[
    int | None,
    typer.Option(
        min=2,
        max=100_000,
        help="Check the covariance: solve N times with frames drawn with replacement.",
    ),
]
ToleratedDegOption = Annotated[
    float | None,
    typer.Option(metavar="DEG", help="Rotation by which a PASS may be off; by default 0.5."),
]
ToleratedCmOption = Annotated[
    float | None,
    typer.Option(metavar="CM", help="Distance by which a PASS may be off; by default 10."),
]
CommonDegOption = Annotated[
    float | None,
    typer.Option(
        metavar="DEG",
        min=0,
        help="Error per axis that all frames share, 1 sigma; 0 if none. (default: as the table "
        "states)",
    ),
]
CommonCmOption = Annotated[
    float | None,
    typer.Option(metavar="CM", min=0, help="Likewise, of the position."),
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


def _require_stdout(as_json: bool) -> bool:
    """Refuse ``--json`` to a closed stdout before the work, not after it."""
    if as_json:
        from calibgraph.report.as_json import require_stdout

        require_stdout()
    return as_json


PrintGraphOption = Annotated[
    bool,
    typer.Option(
        "--print-graph",
        callback=_require_stdout,
        help="Print every factor of the graph whose optimum is the result, in place of tables.",
    ),
]
GraphOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE.dot", help="Write the graph in Graphviz's language to FILE.dot."),
]
JsonOption = Annotated[
    bool, typer.Option("--json", callback=_require_stdout, help="Print JSON on stdout.")
]
