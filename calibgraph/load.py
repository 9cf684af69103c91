"""Wherever a rig is asked for, several things serve: the one place that tells them apart."""

from __future__ import annotations

from pathlib import Path

from calibgraph.calibration import CALIBRATION_FILE, is_calibration, rig_of_calibration
from calibgraph.errors import FileError
from calibgraph.files import checked_model, read_yaml
from calibgraph.kitti import CALIBRATION_NAME, load_kitti_rig
from calibgraph.rig import Rig

RIG_FILE = "rig.yaml"


def load_rig(path: Path | str) -> Rig:
    """Read a rig from a rig file, a result (file or folder), a dataset or a KITTI sequence folder.

    A result gives the calibrated poses, a KITTI sequence those of its own ``calib.txt``.

    Raises:
        FileError: if there is none, or it is malformed.
    """
    path = Path(path)
    if path.is_dir():
        return _load_from_folder(path)
    content = read_yaml(path)
    if is_calibration(content):
        return rig_of_calibration(content, path)
    return checked_model(Rig, content, path)


def _load_from_folder(folder: Path) -> Rig:
    names = (CALIBRATION_FILE, RIG_FILE)
    if (folder / "lidar").is_dir():  # a dataset, which may have a result written into it
        names = (RIG_FILE, CALIBRATION_FILE)
    for name in names:
        if (folder / name).is_file():
            return load_rig(folder / name)
    if (folder / CALIBRATION_NAME).is_file():
        return load_kitti_rig(folder)
    raise FileError(
        folder, f"holds none of {CALIBRATION_FILE}, {RIG_FILE}, {CALIBRATION_NAME} (KITTI)"
    )
