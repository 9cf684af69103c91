"""Write a result or a rig in the format of another program."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Final

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError
from calibgraph.files import read_yaml, require_new_file, write_text
from calibgraph.io.calibrations import is_calibration, load_calibration
from calibgraph.io.formats.documents import commented
from calibgraph.io.formats.names import EXPORT_FORMATS
from calibgraph.io.formats.rig_export import RigExport, prepare_export
from calibgraph.io.formats.transforms import TRANSFORMS, write_transforms
from calibgraph.io.formats.writers import (
    kitti_statement,
    write_camera_infos,
    write_json,
    write_kalibr,
    write_kitti,
    write_opencv,
)
from calibgraph.io.kitti import CALIBRATION_NAME
from calibgraph.io.rigs import load_rig, rig_file
from calibgraph.model.calibration import Calibration
from calibgraph.model.rig import Rig, rigid_transform

Writer = Callable[[RigExport], str | Mapping[str, str]]
"""Of one file, or of the files of a folder by name."""

WRITERS: Final[Mapping[str, Writer]] = {
    "kalibr": write_kalibr,
    **{name: partial(write_transforms, format=name) for name in TRANSFORMS},
    "kitti": write_kitti,
    "camera_info": write_camera_infos,
    "opencv": write_opencv,
    "json": write_json,
}
_WITH_BASE = "autoware"
_WITHOUT_COMMENTS = "kitti"


def export_calibration(  # noqa: PLR0913
    source: Calibration | Rig | Path | str,
    path: Path | str,
    format: str,
    *,
    cameras: Iterable[str] | None = None,
    lidar_frame: str | None = None,
    camera_frame: str | None = None,
    T_base_lidar: Array | None = None,
    even_if_failed: bool = False,
    force: bool = False,
) -> tuple[Path, ...]:
    """Write a calibration for another program, with its direction and a worked point.

    Args:
        source: a result or a rig, or the path of one.
        path: the file to write, of ``camera_info`` the folder.
        format: a name of ``calibgraph.io.formats.names.EXPORT_FORMATS``.
        cameras: names of those to write; all if None.
        lidar_frame: frame id of the LiDAR; the rig's name of it if None.
        camera_frame: id of optical frames, with ``{camera}`` for the camera's name; that of the
            rig, as its bag names it, or ``{camera}_optical_frame`` if None.
        T_base_lidar: (4, 4) pose of the LiDAR in ``sensor_kit_base_link`` (autoware); the
            identity if None.
        even_if_failed: whether to write cameras whose verdict is FAIL.
        force: whether to replace files that are there.

    Returns:
        The files: one, and for ``kitti``, which has no comments, a text file beside it; for
        ``camera_info`` one of each camera.

    Raises:
        CalibrationError: if the verdict is FAIL, or the format or the file cannot hold it.
        ValueError: if an argument is wrong.
    """
    _require_known(format, with_base=T_base_lidar is not None)
    found = _loaded(source) if isinstance(source, (str, Path)) else source
    prepared = prepare_export(
        found,
        cameras=cameras,
        lidar_frame=lidar_frame,
        camera_frame=camera_frame,
        T_base_lidar=None if T_base_lidar is None else rigid_transform(T_base_lidar),
    )
    if isinstance(found, Calibration) and not even_if_failed:
        _require_not_failed(found, [*prepared.cameras])
    return _write(prepared, Path(path), format, force=force)


def _require_not_failed(result: Calibration, cameras: Sequence[str]) -> None:
    """Check the verdicts of the cameras that are to be written."""
    failed = [name for name in cameras if result.camera_verdicts[name].status == "FAIL"]
    if not failed:
        return
    good = [name for name in cameras if name not in failed]
    named = " ".join(f"--camera {quote(name)}" for name in good)
    others = f"export the others with {named}, " if good else ""
    raise CalibrationError(
        f"the verdict of {', '.join(failed)} is FAIL, nothing was written; see the result's "
        f"report, {others}or export all the same with --even-if-failed"
    )


def _require_known(format: str, *, with_base: bool) -> None:
    """Check the format, and that it has a base frame if one is given."""
    if format not in WRITERS:
        raise ValueError(f"format {format!r}: known are {', '.join(EXPORT_FORMATS)}")
    if with_base and format != _WITH_BASE:
        raise ValueError(f"the LiDAR's pose is for the format {_WITH_BASE} only")


def _loaded(path: Path | str) -> Calibration | Rig:
    """A result with its verdict, or a rig."""
    file = rig_file(path)
    if file.name != CALIBRATION_NAME and is_calibration(read_yaml(file)):
        return load_calibration(file)
    return load_rig(file)


def _statement_of(path: Path) -> Path:
    """Beside the file of a format without comments, one with its direction."""
    return path.with_name(f"{path.stem}.direction.txt")


def _write(export: RigExport, path: Path, format: str, *, force: bool) -> tuple[Path, ...]:
    """Write all files or, if one may not be replaced, none."""
    written = WRITERS[format](export)
    contents = {path: written} if isinstance(written, str) else {
        path / name: content for name, content in written.items()
    }  # fmt: skip
    if format == _WITHOUT_COMMENTS:
        contents[_statement_of(path)] = commented(kitti_statement(export))
    for file in contents:
        require_new_file(file, force=force)
    for file, content in contents.items():
        write_text(file, content)
    return tuple(contents)
