"""Rigs from disk: rig files, results, dataset folders, published data sets, ROS bags; in words."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import FileError
from calibgraph.files import checked_model, read_json, read_yaml
from calibgraph.io.bags import BagOptions, is_bag
from calibgraph.io.bags.rig import read_bag_rig
from calibgraph.io.calibrations import is_calibration, rig_of_calibration
from calibgraph.io.dataset_folders import LIDARS, published_folder
from calibgraph.io.kitti import CALIBRATION_NAME, kitti_sequence
from calibgraph.model.geometry import angle_deg, camera_center
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
    return read_rig(path, bag)[0]


def read_rig(path: Path | str, bag: BagOptions | None = None) -> tuple[Rig, tuple[str, ...]]:
    """As :func:`load_rig`, with notes on what was left out, added or taken from elsewhere."""
    path = rig_file(path)
    if is_bag(path):
        read = read_bag_rig(path, bag)
        return read.to_rig(), read.notes
    published = published_folder(path)
    if published is not None:
        return published.read_rig(path)
    if path.name == CALIBRATION_NAME:
        return kitti_sequence(path.parent).read_rig(path.parent)
    return _rig_of_file(path), ()


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
    if keys := list(_placeholders(content, "")):
        others = f", and {len(keys) - 1} more keys" if keys[1:] else ""
        raise FileError(path, f"{keys[0]} is still {FILL_IN}{others}; write the values of your rig")
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


def _placeholders(content: object, key: str) -> Iterator[str]:
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
    names = [CALIBRATION_FILE, RIG_FILE]
    if any((folder / clouds).is_dir() for clouds in ("lidar", LIDARS)):
        names.reverse()  # a dataset may have a result written into it
    paths = (folder / name for name in (*names, CALIBRATION_NAME))
    return next((path for path in paths if path.is_file()), None)


_LIDAR_SIDES = (("ahead", "behind"), ("left", "right"), ("above", "below"))
_CAMERA_SIDES = (("right", "left"), ("below", "above"), ("ahead", "behind"))
_LEAST_M = 0.005
_LEAST_DEG = 0.5
_LEAST_ROLL_DEG = 5.0  # below, a camera hangs straight
_UPRIGHT = 0.95  # of sin(elevation), 72 deg: beyond, left and right mean little


def describe_rig(rig: Rig) -> list[str]:
    """One sentence per camera and LiDAR, in a frame x forward, y left, z up, and relative pose."""
    lines = []
    for name, T in rig.T_camera_lidar.items():
        center = _position(camera_center(T), _LIDAR_SIDES, "the LiDAR")
        lines.append(f"{name} looks {_direction(T)}, {center}")
    for name in rig.other_lidars:
        if name not in rig.T_base_lidar:
            lines.append(f"LiDAR {name} has no guess")
            continue
        pose = rig.T_base_lidar[name]
        where = _position(pose[:3, 3], _LIDAR_SIDES, rig.lidar)
        turned = f"turned by {angle_deg(pose[:3, :3]):.0f} deg against it"
        lines.append(f"LiDAR {name} {where}, {turned}")
    for pair in rig.relative_poses:
        sigma_deg = math.degrees(pair.rotation_sigma_rad)
        lines.append(
            f"{pair.b} {_position(pair.T_a_b[:3, 3], _CAMERA_SIDES, pair.a)}, in the axes of "
            f"{pair.a}, turned by {angle_deg(pair.T_a_b[:3, :3]):.1f} deg against it (1 sigma: "
            f"{sigma_deg:.2g} deg, {100 * pair.translation_sigma_m:.2g} cm)"
        )
    return lines


def _direction(T_camera_lidar: Array) -> str:
    """The axis of the LiDAR frame nearest to the optical axis, and the angles from it."""
    _, down, axis = T_camera_lidar[:3, :3]
    if abs(axis[2]) > _UPRIGHT:
        off = math.degrees(math.acos(min(1.0, abs(float(axis[2])))))
        words = f"along LiDAR {'+' if axis[2] > 0 else '-'}z"
        return words + (f", {off:.0f} deg off it" if off >= _LEAST_DEG else "")
    index = int(np.argmax(np.abs(axis[:2])))
    sign = "+" if axis[index] > 0 else "-"
    heading = math.degrees(math.atan2(axis[1], axis[0]))
    nearest = {"+x": 0.0, "+y": 90.0, "-x": 180.0, "-y": -90.0}[f"{sign}{'xy'[index]}"]
    turned = (heading - nearest + 180.0) % 360.0 - 180.0
    raised = math.degrees(math.asin(axis[2]))
    words = f"along LiDAR {sign}{'xy'[index]}"
    parts = [_turn(turned, "to the left", "to the right"), _turn(raised, "up", "down")]
    parts.append(_roll(axis, down))
    return ", ".join([words, *(part for part in parts if part)])


def _turn(angle: float, positive: str, negative: str) -> str:
    if abs(angle) < _LEAST_DEG:
        return ""
    return f"{abs(angle):.0f} deg {positive if angle > 0 else negative}"


def _roll(axis: Array, down: Array) -> str:
    """How far the image is turned about the optical axis, if it is."""
    level = np.cross(axis, [0.0, 0.0, 1.0])  # to the right, in the horizontal plane
    level /= np.linalg.norm(level)
    straight = np.cross(axis, level)
    roll = math.degrees(math.atan2(float(down @ level), float(down @ straight)))
    return f"its image turned by {abs(roll):.0f} deg" if abs(roll) >= _LEAST_ROLL_DEG else ""


def _position(offset_m: Array, sides: Sequence[tuple[str, str]], what: str) -> str:
    parts = [
        (abs(value), side[0] if value > 0 else side[1])
        for value, side in zip(offset_m.tolist(), sides, strict=True)
        if abs(value) >= _LEAST_M
    ]
    if not parts:
        return f"sits at {what}"
    texts = [f"{value:.2f} m {side}" for value, side in parts]
    joined = " and ".join([", ".join(texts[:-1]), texts[-1]] if len(texts) > 1 else texts)
    preposition = "" if parts[-1][1] in ("above", "below", "behind") else "of "
    return f"sits {joined} {preposition}{what}"
