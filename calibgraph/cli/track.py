"""The command that keeps a rig calibrated while driving: track."""

from pathlib import Path

import typer
from typer import Argument, Option

from calibgraph.cli import options
from calibgraph.cli.arguments import bag_options_from, checked_arguments, matcher_from
from calibgraph.cli.terminal import elapsed_s, print_line, terminal


def track(
    rig: Path = Argument(..., metavar="RIG", help="Rig with the initial guess."),
    source: list[Path] = Argument(
        ...,
        metavar="SOURCE...",
        help="Table of correspondences (.parquet, .csv), or - for standard input (a JSON line per "
        "frame). With --matcher: datasets or ROS bags of one rig, as one drive.",
    ),
    out: Path = Option(
        Path("tracking"),
        metavar="DIR",
        help="Folder for the state, the result and a picture. A state in it is resumed.",
    ),
    step: int = Option(1, min=1, help="Take every N-th frame only."),
    matcher: str | None = Option(None, metavar="NAME", help="Match frames: structure or cmrnext."),
    interval_s: options.IntervalS = None,
    topic: options.Topic = None,
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
    from calibgraph.io.rigs import load_rig
    from calibgraph.model.result_files import require_result_folder
    from calibgraph.report.tables import print_result
    from calibgraph.tracking.command import Tracking, track
    from calibgraph.tracking.state import require_poses_alone

    require_result_folder(out, [rig, *source])
    with checked_arguments():
        settings, rare = read_settings(config, seed=seed)
        require_poses_alone(settings)
        if matcher is None:
            given = {"--interval-s": interval_s, "--topic": topic or None, "--motion": motion,
                     "--weights": weights}  # fmt: skip
            _require_matcher_for(source, given | rare.of_cmrnext)
            chosen = None
        else:
            chosen = matcher_from(matcher, weights, seed=settings.seed, of_cmrnext=rare.of_cmrnext)
    wanted = Tracking(
        rig=load_rig(rig),
        config=settings,
        out=out,
        every=step,
        matcher=chosen,
        interval_s=interval_s,
        bag=bag_options_from(topic, motion=motion, **rare.of_bags),
    )
    result, written = track(wanted, source, notify=print_line)
    print_result(terminal(), result, written, elapsed_s())
    if result.verdict.status == "FAIL":
        raise typer.Exit(1)


def _require_matcher_for(source: list[Path], given: dict[str, object]) -> None:
    """Refuse what is for clouds and images without a matcher: tables bring their motion."""
    from calibgraph.model.clock import OF_TABLES

    for name, value in given.items():
        if value is not None:
            motion = f"; give {OF_TABLES}" if name in ("--interval-s", "--motion") else ""
            raise ValueError(f"{name} goes with --matcher only{motion}")
    if len(source) > 1:
        raise ValueError(f"{len(source)} sources given; several go with --matcher only")
