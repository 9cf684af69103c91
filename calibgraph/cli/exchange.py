"""The commands for the formats of others: export, import."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibgraph.cli import outputs
from calibgraph.cli.arguments import checked_arguments
from calibgraph.cli.terminal import print_plain, terminal
from calibgraph.io.formats.names import EXPORT_FORMATS, IMPORT_FORMATS

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from calibgraph.io.formats.rig_import import RigParts
    from calibgraph.model.rig import Rig

_LIST = "list"


@dataclass(frozen=True, kw_only=True)
class RigFilesOptions:
    """The files of other programs that hold a rig together.

    Attributes:
        rename (OLD=NEW): Another name of a camera, as its folder in the dataset; may be repeated.
        lidar_frame (FRAME): The LiDAR's frame. (default: the one named so)
        camera_frame (NAME=FRAME): Frame of a camera, where the names differ; may be repeated. A
            frame with 'optical' in its name is x right, y down, z forward, others are x forward, z
            up.
        size (WIDTHxHEIGHT): Image size, for files that have none.
    """

    files: Annotated[
        list[str],
        typer.Argument(
            metavar="FILE...",
            help=f"{IMPORT_FORMATS}. NAME=FILE names the camera of a file of one camera.",
        ),
    ]
    rename: list[str] | None = None
    lidar_frame: str | None = None
    camera_frame: list[str] | None = None
    size: str | None = None

    def read(self) -> RigParts:
        """What the files hold."""
        from calibgraph.io.formats.rig_import import read_rig_parts

        named = [_parse_file(text) for text in self.files]
        return read_rig_parts(
            [path for _, path in named],
            names={path: name for name, path in named if name},
            rename=parse_names("--rename", self.rename),
            lidar_frame=self.lidar_frame,
            camera_frames=parse_names("--camera-frame", self.camera_frame),
        )

    @property
    def size_px(self) -> tuple[int, int] | None:
        """Width and height of images whose file has none."""
        if self.size is None:
            return None
        match = re.fullmatch(r"(\d+)x(\d+)", self.size)
        if match is None:
            raise ValueError(f"--size {self.size!r}: give WIDTHxHEIGHT, as 1920x1200")
        return int(match[1]), int(match[2])


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
    source: Path,
    format: Annotated[
        str,
        typer.Option(
            metavar="FORMAT",
            callback=_list_formats,
            is_eager=True,
            help=f"{', '.join(EXPORT_FORMATS)}; list: what these are.",
        ),
    ],
    out: Annotated[Path, typer.Option(), outputs.EXPORTED],
    camera: list[str] | None = None,
    lidar_frame: str | None = None,
    camera_frame: str | None = None,
    lidar_pose: str | None = None,
    even_if_failed: bool = False,
) -> None:
    """Write a calibration in the format of another program, with its direction as a comment.

    Args:
        source (RESULT|RIG): Result (its folder or file), or a rig.
        out (FILE): File to write; of camera_info a folder.
        camera (NAME): Only this camera; may be repeated. (default: all)
        lidar_frame (FRAME): Frame id of the LiDAR. (default: its name in the rig)
        camera_frame (TEXT): Frame id of optical frames; {camera} is the name. (default: the bag's,
            kept in the rig, or {camera}_optical_frame)
        lidar_pose ("X Y Z ROLL PITCH YAW"): Of autoware: where the LiDAR is mounted,
            in sensor_kit_base_link, metres and radians as in URDF. (default: at its origin)
        even_if_failed: Export although the verdict is FAIL.
    """
    import numpy as np

    from calibgraph.io.formats.export import export_calibration
    from calibgraph.io.rigs import load_rig
    from calibgraph.model.plausibility import MAX_DISTANCE_M

    with checked_arguments():
        T_base_lidar = None if lidar_pose is None else _parse_pose(lidar_pose)
        written = export_calibration(
            source,
            out,
            format,
            cameras=camera or None,
            lidar_frame=lidar_frame,
            camera_frame=camera_frame,
            T_base_lidar=T_base_lidar,
            even_if_failed=even_if_failed,
        )
        rig = load_rig(source)
    rig = rig.model_copy(
        update={"cameras": {name: rig.cameras[name] for name in camera or rig.cameras}}
    )
    if T_base_lidar is not None and np.linalg.norm(T_base_lidar[:3, 3]) > MAX_DISTANCE_M:
        print_plain(terminal(), f"warning: --lidar-pose {lidar_pose!r}: lengths in millimetres?")
    print_doubts(rig)
    for path in written:
        print_plain(terminal(), f"{path}: written ({format})")


def _parse_pose(text: str) -> NDArray[np.float64]:
    """The (4, 4) of six numbers."""
    from calibgraph.io.rotations import pose_of_angles

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


def import_(
    files: RigFilesOptions,
    out: Annotated[Path, typer.Option(), outputs.rig_of("import")],
    tie_deg: Annotated[float, typer.Option(min=0.001)] = 0.1,
    tie_m: Annotated[float, typer.Option(min=1e-5)] = 0.005,
    correct: list[str] | None = None,
) -> None:
    """Build a rig file from files of others, and print where each camera looks and sits.

    Args:
        out (FILE.yaml): Rig file to write.
        tie_deg (DEG): Sigma per axis of relative poses (Kalibr's T_cn_cnm1).
        tie_m (M): The sigma in translation, per axis.
    """
    from calibgraph.io.formats.describe import describe_rig
    from calibgraph.model.lens_knowledge import state_calibrated
    from calibgraph.outputs import yaml_mark
    from calibgraph.trust.conventions import correct_guess

    with checked_arguments():
        parts = files.read()
        rig = parts.to_rig(
            size_px=files.size_px,
            relative_sigma_deg=tie_deg,
            relative_sigma_cm=100.0 * tie_m,
        )
        rig = state_calibrated(correct_guess(rig, correct or ()))
    rig.save(out, first_line=yaml_mark("import"))
    print_doubts(rig, parts.notes)
    for sentence in describe_rig(rig):
        print_plain(terminal(), sentence)
    cameras = "1 camera" if len(rig.cameras) == 1 else f"{len(rig.cameras)} cameras"
    print_plain(terminal(), f"{out}: {cameras}; check the sentences above against the vehicle")


def print_doubts(rig: Rig, notes: Sequence[str] = ()) -> None:
    """Print what was assumed of files, and the values of a rig that cannot be right."""
    from calibgraph.model.plausibility import find_implausible

    for note in notes:
        print_plain(terminal(), f"note: {note}")
    for line in find_implausible(rig):
        print_plain(terminal(), f"warning: {line}")


def _parse_file(text: str) -> tuple[str, Path]:
    """The camera's name, if there is one before ``=``, and the file."""
    name, equals, file = text.partition("=")
    return (name, Path(file)) if equals and not Path(text).exists() else ("", Path(text))


def parse_names(option: str, texts: list[str] | None) -> dict[str, str]:
    """The pairs of a repeated option A=B."""
    for text in texts or ():
        if "=" not in text:
            raise ValueError(f"{option} {text!r}: give two names with = between them")
    pairs = [text.partition("=") for text in texts or ()]
    for name, count in Counter(name for name, _, _ in pairs).items():
        if count > 1:
            raise ValueError(f"{option} {name}=...: given {count} times; give it once")
    return {name: value for name, _, value in pairs}
