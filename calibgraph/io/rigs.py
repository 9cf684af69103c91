"""Rigs from disk: rig files, results, dataset folders, published data sets, ROS bags."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from calibgraph.errors import FileError
from calibgraph.files import checked_model, read_json, read_yaml
from calibgraph.io.bags import BagOptions, is_bag
from calibgraph.io.bags.rig import read_bag_rig
from calibgraph.io.calibrations import is_calibration, rig_of_calibration
from calibgraph.io.dataset_folders import published_folder
from calibgraph.io.frame_files import RigRead
from calibgraph.io.kitti import CALIBRATION_NAME, kitti_sequence
from calibgraph.model.result_files import CALIBRATION_FILE
from calibgraph.model.rig import RIG_FORMAT, Camera, Rig

RIG_FILE, REFERENCE_FILE = "rig.yaml", "reference.yaml"
FILL_IN = "FILL_IN"
"""Stands for a value that the user of ``calibgraph rig`` writes."""


def load_rig(path: Path | str, bag: BagOptions | None = None) -> Rig:
    """Read a rig from a rig file, a result, a dataset, a published data set or a bag.

    A result gives the calibrated extrinsics, KITTI, nuScenes and Argoverse their own
    calibration, a bag its /tf_static.

    Args:
        path: a file or folder.
        bag: which topics of a bag are the rig's; those found by type if None.

    Raises:
        FileError, DatasetError: if there is none, or it is malformed.
    """
    return read_rig(path, bag).rig


def read_rig(path: Path | str, bag: BagOptions | None = None) -> RigRead:
    """As :func:`load_rig`, with notes on what was left out, added or taken from elsewhere."""
    path = rig_file(path)
    if is_bag(path):
        read = read_bag_rig(path, bag)
        return RigRead(read.to_rig(), read.notes)
    published = published_folder(path)
    if published is not None:
        return published.read_rig(path)
    if path.name == CALIBRATION_NAME:
        return kitti_sequence(path.parent).read_rig(path.parent)
    return RigRead(_rig_of_file(path))


def _rig_of_file(path: Path) -> Rig:
    """The rig of a rig file, a result or an export."""
    content = read_json(path) if path.suffix.lower() == ".json" else read_yaml(path)
    if is_calibration(content):
        return rig_of_calibration(content, path)
    if is_exported_rig(content):
        return _exported_rig(content, path)
    if "format" not in content:
        raise FileError(
            path, f"key 'format' is missing; add the line `format: {RIG_FORMAT}`, or make a rig "
            "of a file of another program with calibgraph rig"
        )  # fmt: skip
    _require_filled(content, path)
    return checked_model(Rig, content, path)


def is_exported_rig(content: dict[str, Any]) -> bool:
    """Whether the content of a file is of ``calibgraph export --format json``."""
    return "calibgraph_export" in content and isinstance(content.get("cameras"), dict)


def _exported_rig(content: dict[str, Any], path: Path) -> Rig:
    """The rig of an export: its cameras without their error bars, which are of the result."""
    kept = Camera.model_fields.keys() - {"covariance"}
    cameras = {
        name: {key: value for key, value in camera.items() if key in kept}
        for name, camera in content["cameras"].items()
        if isinstance(camera, dict)
    }
    return checked_model(Rig, {"lidar": content.get("lidar_frame"), "cameras": cameras}, path)


def _require_filled(content: object, path: Path) -> None:
    """Refuse a rig file in which a placeholder is left."""
    keys = list(_placeholders(content, ""))
    if keys:
        others = f", and {len(keys) - 1} more keys" if keys[1:] else ""
        raise FileError(path, f"{keys[0]} is still {FILL_IN}{others}; write the values of your rig")


def _placeholders(content: object, key: str) -> Iterator[str]:
    """The keys whose value is a placeholder."""
    if isinstance(content, dict):
        for name, value in content.items():
            yield from _placeholders(value, f"{key}.{name}" if key else str(name))
    elif isinstance(content, list):
        for index, value in enumerate(content):
            yield from _placeholders(value, f"{key}.{index}")
    elif content == FILL_IN:
        yield key


def rig_file(path: Path | str) -> Path:
    """The file that :func:`load_rig` reads: the path itself, or the rig file of a folder."""
    found = find_rig_file(path)
    if found is None or not (found.exists() or published_folder(found)):
        what = f"holds none of {CALIBRATION_FILE}, {RIG_FILE}, {CALIBRATION_NAME} (KITTI)"
        raise FileError(
            path,
            f"{what if found is None else 'no such file or folder'}; name a rig file, a result, a "
            "dataset folder with a rig.yaml (calibgraph rig writes one), a folder of KITTI, "
            "nuScenes or Argoverse 2, or a ROS bag",
        )
    return found


def find_rig_file(path: Path | str) -> Path | None:
    """The path itself, or the rig file of a folder of files; None if it holds none."""
    folder = Path(path)
    if not folder.is_dir() or is_bag(folder) or published_folder(folder):
        return folder
    names = (CALIBRATION_FILE, RIG_FILE)
    if (folder / "lidar").is_dir():  # a dataset, which may have a result written into it
        names = (RIG_FILE, CALIBRATION_FILE)
    paths = (folder / name for name in (*names, CALIBRATION_NAME))
    return next((path for path in paths if path.is_file()), None)
