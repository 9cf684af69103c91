"""The command that keeps a rig calibrated while driving: track."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from typer import Argument, Option

from calibgraph.cli import options
from calibgraph.cli.arguments import bag_options_from, checked_arguments, matcher_from
from calibgraph.cli.terminal import print_plain, terminal

if TYPE_CHECKING:
    from calibgraph.matching.protocol import Matcher


def track(
    rig: Path = Argument(..., metavar="RIG", help="Rig with the initial guess."),
    source: list[Path] = Argument(
        ...,
        metavar="SOURCE...",
        help="Table of correspondences (.parquet, .csv), a growing folder of them, or - for "
        "standard input (a JSON line per frame). With --matcher: dataset folders, KITTI "
        "sequences or ROS bags of one rig, as one drive.",
    ),
    out: Path = Option(
        Path("tracking"),
        metavar="DIR",
        help="Folder for the state, the result and a picture. A state in it is resumed.",
    ),
    every: int = Option(1, min=1, help="Take every N-th frame only."),
    follow: bool = Option(
        False, "--follow", help="Wait for new files in the folder, until stopped."
    ),
    matcher: str | None = Option(
        None, metavar="NAME", help="Match the frames of a dataset: structure or cmrnext."
    ),
    estimate: str | None = Option(
        None,
        metavar="offset",
        help="Follow the time offset of each camera: how long after its points an image is "
        "taken. The motion of the LiDAR must be known.",
    ),
    interval_s: options.IntervalS = None,
    motion: options.Motion = None,
    weights: options.Weights = None,
    config: options.ConfigFile = None,
    seed: options.SeedOrConfig = None,
) -> None:
    """Keep all cameras calibrated while driving: one frame in, one line of JSON out.

    Each line on standard output is one update: estimates, covariances, verdicts, and events (what
    moved, since when, how far). It is printed once the update is on disk: after a crash or kill -9
    the same command resumes there, and may print the last lines again. SIGTERM and Ctrl-C finish
    the current update first.

    Frames of one place (within some 20 m) share errors: name it in each line ("place") or list the
    frames of each in the table ("places"). Otherwise all are of one place, and the error bar stays
    as wide. With --matcher structure places are found from the images.
    """
    from calibgraph.cli.settings import read_settings
    from calibgraph.cli.tables import print_result
    from calibgraph.io.rigs import load_rig
    from calibgraph.model.result_files import require_result_folder
    from calibgraph.tracking.command import Tracking, track
    from calibgraph.tracking.offsets import require_offset_alone

    require_result_folder(out, [rig, *source])
    with checked_arguments():
        settings, rare = read_settings(config, seed=seed, estimate=estimate)
        require_offset_alone(settings)
        if not matcher:
            _require_matcher_for(interval_s=interval_s, motion=motion)
        chosen = _tracking_matcher(matcher, weights, source, settings.seed, rare.of_cmrnext)
    console = terminal()
    wanted = Tracking(
        rig=load_rig(rig),
        config=settings,
        out=out,
        every=every,
        follow=follow,
        matcher=chosen,
        interval_s=interval_s,
        bag=bag_options_from(None, motion=motion, **rare.of_bags),
    )
    result, written = track(wanted, source, notify=lambda text: print_plain(console, text))
    print_result(console, result, written)
    if result.verdict.status == "FAIL":
        raise typer.Exit(1)


def _require_matcher_for(**given: float | str | None) -> None:
    """Refuse options for clouds without a matcher: correspondences bring their motion."""
    for name, value in given.items():
        if value is not None:
            option = f"--{name.replace('_', '-')}"
            columns = "columns wx_rad_s to vz_m_s, lines have twist_per_s"
            raise ValueError(
                f"{option} goes with --matcher only: for the motion, tables have {columns}"
            )


def _tracking_matcher(
    name: str | None,
    weights: list[Path] | None,
    source: list[Path],
    seed: int,
    of_cmrnext: dict[str, Any],
) -> Matcher | None:
    """The matcher for the frames of datasets; None for a source of correspondences."""
    if name:
        return matcher_from(name, weights, seed=seed, of_cmrnext=of_cmrnext)
    for what in ("--weights",) if weights else of_cmrnext:
        raise ValueError(f"{what} is for --matcher cmrnext only")
    if len(source) > 1:
        raise ValueError(f"{len(source)} sources given; several go with --matcher only")
    return None
