"""Options that several commands share, and their values as objects of the library."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

import calibgraph
from calibgraph.cli.terminal import print_line, progress_bar
from calibgraph.errors import CalibrationError
from calibgraph.stdout import require_stdout

_SEARCH_LIMIT_S = 1800.0


@contextmanager
def checked_arguments() -> Iterator[None]:
    """Turn the library's ``ValueError`` for a wrong argument into a one-line error."""
    try:
        yield
    except ValueError as error:
        raise CalibrationError(str(error)) from error


def dataset_from(
    folders: list[Path],
    rig: Path | None,
    frames: str | None,
    bag: calibgraph.BagOptions | None = None,
    *,
    interval_s: float | None = None,
) -> calibgraph.Dataset:
    """The dataset in these folders; of bags, a line each is printed."""
    with checked_arguments(), progress_bar("reading"):
        known = calibgraph.load_rig(rig) if rig else None
        data = calibgraph.load_dataset(
            folders, known, frames=frames, bag=bag, interval_s=interval_s
        )
    print_line(*data.notes)
    return data


def bag_settings(
    config: Path | None, topic: list[str] | None, **options: Any
) -> calibgraph.BagOptions | None:
    """How bags are read, by a file of settings and options; None if neither has anything of it.

    Raises:
        CalibrationError: if a value is out of range, or a topic has no name.
    """
    from calibgraph.cli.settings import read_settings

    with checked_arguments():
        options |= read_settings(config)[1].of_bags
        given = {name: value for name, value in options.items() if value is not None}
        if not topic and not given:
            return None
        topics = parse_names("--topic", topic, "NAME=/TOPIC, as lidar=/velodyne_points")
        return calibgraph.BagOptions(topics=topics, **given)


def matcher_from(
    name: str,
    weights: list[Path] | None = None,
    *,
    seed: int,
    all_frames: bool = False,
    of_cmrnext: Mapping[str, Any] | None = None,
    **search: float | None,
) -> calibgraph.Matcher:
    """The matcher of that name, or a table of correspondences.

    Args:
        name: ``structure``, ``cmrnext`` or a file.
        weights: of cmrnext.
        seed: of everything random.
        all_frames: match all frames, as when the user has selected them.
        of_cmrnext: its settings.
        search: the search_deg and search_m of structure; None if not given, 0 for no search.
    """
    for option in search if name != "structure" else ():
        if search[option] is not None:
            raise ValueError(f"--{option.replace('_', '-')} is for --matcher structure only")
    for option in [*(["--weights"] if weights else []), *(of_cmrnext or {})]:
        if name != "cmrnext":
            raise ValueError(f"{option} is for --matcher cmrnext only")
    from calibgraph.matching.named import find_matcher, structure_matcher

    if name == "structure":
        return structure_matcher(seed=seed, all_frames=all_frames, **search)
    if name == "cmrnext" and weights:
        from calibgraph.matching.cmrnext import CmrNextMatcher

        return CmrNextMatcher(weights, seed=seed, **of_cmrnext or {})
    return find_matcher(name, seed=seed)


def time_limit_of(matcher: str, time_limit_s: float | None) -> float | None:
    """The time limit, by default the search's. Networks may need hours on a CPU."""
    default = _SEARCH_LIMIT_S if matcher == "structure" else None
    return default if time_limit_s is None else time_limit_s


def parse_names(
    option: str, texts: list[str] | None, form: str = "two names with = between them"
) -> dict[str, str]:
    """The pairs of a repeated option A=B."""
    for text in texts or ():
        if not all(text.partition("=")):
            raise ValueError(f"{option} {text!r}: give {form}")
    pairs = [text.partition("=") for text in texts or ()]
    for name, count in Counter(name for name, _, _ in pairs).items():
        if count > 1:
            raise ValueError(f"{option} {name}=...: given {count} times; give it once")
    return {name: value for name, _, value in pairs}


_BAGS, _STRUCTURE = "ROS bags", "Matcher structure"
_MOST_SEED = 2**31 - 1


Datasets = Annotated[
    list[Path],
    Argument(
        metavar="DATASET...",
        help="Dataset folder (rig.yaml, lidar/ or lidars/NAME/, cameras/NAME/), KITTI sequence or "
        "raw drive, nuScenes folder or scene, Argoverse 2 log, or ROS bag; several of one rig "
        "together.",
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
        help="Topic of a camera's images, of clouds as lidar=/TOPIC (of several LiDARs "
        "with their names), or of odometry=/TOPIC; "
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
        "their registration. For --estimate offset or readout, and to correct clouds whose points "
        "have times. (default: unknown)",
    ),
]
MatcherName = Annotated[
    str, Option(metavar="NAME|FILE", help="structure, cmrnext, or a table of correspondences.")
]
_WEIGHTS = "Networks of cmrnext (iter1.tar); repeat it in the order in which they run."
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
