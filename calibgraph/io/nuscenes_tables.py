"""The tables of a nuScenes folder: records tied by tokens, read as far as they are needed.

A sample_data (an image or a scan) is of one sample (an instant), has a calibrated_sensor (the pose
of its sensor in the vehicle, ego) and an ego_pose (the vehicle's pose when it was taken).
"""

import json
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import BaseModel

from calibgraph.arrays import Array
from calibgraph.errors import FileError
from calibgraph.files import checked_model, read_text
from calibgraph.io.rotations import pose_of_quaternion
from calibgraph.model.rig import Finite

Record = TypeVar("Record", bound="_Record")

LIDAR = "LIDAR_TOP"
_KEPT_TABLES = 2

_Triple = tuple[Finite, Finite, Finite]


class _Record(BaseModel):
    token: str


class Pose(_Record):
    """Of a sensor in ego, or of ego in the world."""

    translation: _Triple
    rotation: tuple[Finite, Finite, Finite, Finite]  # w x y z

    def matrix(self, where: Path) -> Array:
        """(4, 4), from the sensor's or ego's coordinates."""
        w, x, y, z = self.rotation
        try:
            return pose_of_quaternion(self.translation, (x, y, z, w))
        except ValueError as error:
            raise FileError(where, f"record {self.token}: {error}") from error


class CalibratedSensor(Pose):
    """The pose of a sensor in ego, and a camera's matrix."""

    sensor_token: str
    camera_intrinsic: tuple[_Triple, ...] = ()


class _Sensor(_Record):
    channel: str
    modality: Literal["camera", "lidar", "radar"]


class _Sample(_Record):
    timestamp: int  # [us]
    scene_token: str


class _Scene(_Record):
    name: str


class SampleData(_Record):
    """An image or a scan."""

    sample_token: str
    ego_pose_token: str
    calibrated_sensor_token: str
    filename: str
    width: int | None = None
    height: int | None = None


@dataclass(frozen=True)
class Instant:
    """A sample, with its images and its scan by channel."""

    stamp_us: int
    scene: str
    taken: Mapping[str, SampleData]


@dataclass(frozen=True, eq=False)
class Tables:
    """The samples of a nuScenes folder, or of one of its scenes."""

    folder: Path
    instants: tuple[Instant, ...]
    cameras: tuple[str, ...]
    calibrated: Mapping[str, CalibratedSensor]

    def calibration_of(self, taken: SampleData) -> CalibratedSensor:
        """The pose of the sensor that took an image or a scan."""
        return self.calibrated[taken.calibrated_sensor_token]


def find_tables(path: Path) -> tuple[Path, str | None] | None:
    """The folder of the tables, and the scene if the path names one; None if there are no tables.

    Raises:
        FileError: if there are several versions.
    """
    folder, scene = (path, None) if path.exists() else (path.parent, path.name)
    if (folder / "sample_data.json").is_file():
        return folder, scene
    found = sorted(each.parent for each in folder.glob("v1.0-*/sample_data.json"))
    if len(found) > 1:
        names = ", ".join(each.name for each in found)
        raise FileError(folder, f"has the versions {names}; name one: {found[0]}")
    return (found[0], scene) if found else None


def read_tables(path: Path) -> Tables:
    """The samples of a nuScenes folder or scene."""
    found = find_tables(path)
    if found is None:
        raise FileError(path, "no nuScenes tables; expected v1.0-*/sample_data.json")
    folder, scene = found
    whole = _read_all(folder, (folder / "sample_data.json").stat().st_mtime_ns)
    if scene is None:
        return whole
    instants = tuple(each for each in whole.instants if each.scene == scene)
    if not instants:
        names = ", ".join(sorted({each.scene for each in whole.instants}))
        raise FileError(path, f"no such scene; the tables have {names}")
    return replace(whole, instants=instants)


@lru_cache(_KEPT_TABLES)
def _read_all(folder: Path, _changed_ns: int) -> Tables:
    samples = _by_token(folder, "sample", _Sample)
    scenes = _by_token(folder, "scene", _Scene)
    sensors = _by_token(folder, "sensor", _Sensor)
    calibrated = _by_token(folder, "calibrated_sensor", CalibratedSensor)
    taken: dict[str, dict[str, SampleData]] = defaultdict(dict)
    try:
        for each in _by_token(folder, "sample_data", SampleData, only="is_key_frame").values():
            sensor = sensors[calibrated[each.calibrated_sensor_token].sensor_token]
            taken[each.sample_token][sensor.channel] = each
        instants = [
            Instant(samples[token].timestamp, scenes[samples[token].scene_token].name, channels)
            for token, channels in taken.items()
        ]
    except KeyError as error:
        raise FileError(folder, f"its tables have no record {error}; are they complete?") from error
    cameras = sorted(each.channel for each in sensors.values() if each.modality == "camera")
    instants.sort(key=lambda each: each.stamp_us)
    return Tables(folder, tuple(instants), tuple(cameras), calibrated)


def describe_no_scan(tables: Tables) -> str:
    """Why there is no scan: the tables have none, or none of a key frame."""
    sensors = _by_token(tables.folder, "sensor", _Sensor)
    of_lidar = {
        each.token
        for each in tables.calibrated.values()
        if each.sensor_token in sensors and sensors[each.sensor_token].channel == LIDAR
    }
    records = _read_list(tables.folder / "sample_data.json")
    scans = sum(each.get("calibrated_sensor_token") in of_lidar for each in records)
    if not scans:
        return f"has no scan of {LIDAR}"
    return f"has {scans} scans of {LIDAR}, and none is a key frame; only key frames are read"


def read_ego_poses(tables: Tables) -> dict[str, Array] | None:
    """(4, 4) T_world_ego by token, of the samples' images and scans; None without the table."""
    path = tables.folder / "ego_pose.json"
    if not path.is_file():
        return None
    wanted = {each.ego_pose_token for i in tables.instants for each in i.taken.values()}
    records = [each for each in _read_list(path) if each.get("token") in wanted]
    return {
        pose.token: pose.matrix(path)
        for pose in (checked_model(Pose, record, path) for record in records)
    }


def _by_token(
    folder: Path, table: str, model: type[Record], *, only: str | None = None
) -> dict[str, Record]:
    """The records of a table; of a large one, those with a field set."""
    path = folder / f"{table}.json"
    records = (each for each in _read_list(path) if only is None or each.get(only))
    return {each.token: each for each in (checked_model(model, r, path) for r in records)}


def _read_list(path: Path) -> list[dict[str, Any]]:
    """The objects of a JSON list."""
    try:
        content = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise FileError(path, f"is no JSON ({error}); is it complete?") from error
    if not isinstance(content, list) or not all(isinstance(each, dict) for each in content):
        raise FileError(path, "is no table of nuScenes; expected a list of records")
    return content
