"""The command for the formats of others: export."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import typer
from typer import Argument, Option

from calibgraph.cli import options
from calibgraph.cli.arguments import checked_arguments
from calibgraph.cli.terminal import print_line
from calibgraph.io.formats import EXPORT_FORMATS

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


_LIST = "list"


def _list_formats(format: str) -> str:
    """Print the formats for ``--format list``, before other arguments are required."""
    if format == _LIST:
        from calibgraph.report.as_json import print_line

        width = max(map(len, EXPORT_FORMATS))
        lines = (f"{name:{width}}  {meaning}" for name, meaning in EXPORT_FORMATS.items())
        with suppress(BrokenPipeError):
            print_line("\n".join(lines))
        raise typer.Exit
    return format


def export(
    source: Path = Argument(
        ..., metavar="RESULT|RIG", help="Result (its folder or file), or a rig."
    ),
    format: str = Option(
        ...,
        metavar="FORMAT",
        callback=_list_formats,
        is_eager=True,
        help=f"{', '.join(EXPORT_FORMATS)}; list: what these are.",
    ),
    out: Path = Option(..., metavar="FILE", help="File to write; of camera_info a folder."),
    camera: list[str] | None = Option(
        None, metavar="NAME", help="Only this camera; may be repeated. (default: all)"
    ),
    lidar_frame: str | None = Option(
        None, metavar="FRAME", help="Frame id of the LiDAR. (default: its name in the rig)"
    ),
    camera_frame: str | None = Option(
        None,
        metavar="TEXT",
        help="Frame id of optical frames; {camera} is the name. (default: that of the bag, or "
        "{camera}_optical_frame)",
    ),
    lidar_pose: str | None = Option(
        None,
        metavar='"X Y Z ROLL PITCH YAW"',
        help="Of autoware: the LiDAR in sensor_kit_base_link, metres and radians. (default: at 0)",
    ),
    even_if_failed: bool = Option(False, "--even-if-failed", help="Also with the verdict FAIL."),
    force: options.Force = False,
) -> None:
    """Write a calibration in the format of another program, with its direction as a comment."""
    import numpy as np

    from calibgraph.io.formats.export import export_calibration
    from calibgraph.io.rigs import load_rig
    from calibgraph.model.plausibility import MAX_DISTANCE_M, find_implausible

    with checked_arguments():
        T_base_lidar = None if lidar_pose is None else _parse_pose(lidar_pose)
        written = export_calibration(
            source, out, format, cameras=camera or None, lidar_frame=lidar_frame,
            camera_frame=camera_frame, T_base_lidar=T_base_lidar, even_if_failed=even_if_failed,
            force=force,
        )  # fmt: skip
        rig = load_rig(source)
    rig = rig.model_copy(
        update={"cameras": {name: rig.cameras[name] for name in camera or rig.cameras}}
    )
    if T_base_lidar is not None and np.linalg.norm(T_base_lidar[:3, 3]) > MAX_DISTANCE_M:
        print_line(f"warning: --lidar-pose {lidar_pose!r}: lengths in millimetres?")
    lines = [f"warning: {line}" for line in find_implausible(rig)]
    for line in [*lines, *(f"{path}: written ({format})" for path in written)]:
        print_line(line)


def _parse_pose(text: str) -> NDArray[np.float64]:
    """The (4, 4) of six numbers."""
    from calibgraph.io.rig_parts import pose_of_angles

    try:
        x, y, z, roll, pitch, yaw = (float(word) for word in text.replace(",", " ").split())
    except ValueError as error:
        raise ValueError(
            f"--lidar-pose {text!r}: give six numbers, X Y Z ROLL PITCH YAW"
        ) from error
    try:
        return pose_of_angles((x, y, z), (roll, pitch, yaw))
    except ValueError as error:
        raise ValueError(f"--lidar-pose {text!r}: {error}") from error
