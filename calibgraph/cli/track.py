"""The command that keeps a rig calibrated while driving: track."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibgraph.cli import options, outputs
from calibgraph.cli.arguments import bag_options_from, checked_arguments, config_from, matcher_from
from calibgraph.cli.terminal import print_plain, terminal

if TYPE_CHECKING:
    from calibgraph.matching.protocol import Matcher


def track(
    rig: Path,
    source: list[Path],
    out: Annotated[Path, outputs.RESULT] = Path("tracking"),
    every: Annotated[int, typer.Option(min=1)] = 1,
    follow: bool = False,
    matcher: str | None = None,
    interval_s: float | None = None,
    motion: options.MotionOption = None,
    config: Path | None = None,
    preset: str | None = None,
    seed: options.ConfigSeedOption = None,
    weights: options.WeightsOption = None,
    device: options.DeviceOption = None,
) -> None:
    """Keep all cameras calibrated while driving: one frame in, one line of JSON out.

    Each line on standard output is one update: estimates, covariances, verdicts, and events (what
    moved, since when, how far). It is printed once the update is on disk: after a crash or kill -9
    the same command resumes there, and may print the last lines again. SIGTERM and Ctrl-C finish
    the current update first.

    Frames of one place (within some 20 m) share errors: name it in each line ("place") or list the
    frames of each in the table ("places"). Otherwise all are of one place, and the error bar stays
    as wide. With --matcher structure places are found from the images.

    Args:
        rig (RIG): Rig with the initial guess.
        source (SOURCE...): Table of correspondences (.parquet, .csv), a growing folder of them, or
            - for standard input (a JSON line per frame). With --matcher:
            dataset folders, KITTI sequences or ROS bags of one rig, as one drive.
        out (DIR): Folder for the state, the result and a picture. A state in it is resumed.
        every: Take every N-th frame only.
        follow: Wait for new files in the folder, until stopped.
        matcher (NAME): Match the frames of a dataset: structure or cmrnext.
        interval_s (SECONDS): Time between neighbouring clouds of a folder, with --matcher: the
            motion of the LiDAR is found by their registration. For cameras whose rig states a
            time offset or read-out. (default: unknown)
    """
    from calibgraph.cli.tables import print_result
    from calibgraph.io.rigs import load_rig
    from calibgraph.tracking.command import Tracking, track
    from calibgraph.tracking.state import require_poses_alone

    with checked_arguments():
        settings = config_from(config, preset, seed=seed)
        require_poses_alone(settings)
        if not matcher:
            _require_matcher_for(interval_s=interval_s, motion=motion)
        chosen = _tracking_matcher(matcher, weights, source, seed=settings.seed, device=device)
    console = terminal()
    wanted = Tracking(
        rig=load_rig(rig),
        config=settings,
        out=out,
        every=every,
        follow=follow,
        matcher=chosen,
        interval_s=interval_s,
        bag=bag_options_from(None, motion=motion),
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
    *,
    seed: int,
    device: str | None,
) -> Matcher | None:
    """The matcher for the frames of datasets; None for a source of correspondences."""
    if name:
        return matcher_from(name, weights, seed=seed, device=device)
    for option, value in (("--weights", weights), ("--device", device)):
        if value:
            raise ValueError(f"{option} is for --matcher cmrnext only")
    if len(source) > 1:
        raise ValueError(f"{len(source)} sources given; several go with --matcher only")
    return None
