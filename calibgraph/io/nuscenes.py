"""nuScenes folders: tables of records tied by tokens, read as far as they are needed.

A sample_data (an image or a scan) is of one sample (an instant), and has a calibrated_sensor (the
pose of its sensor in the vehicle, ego). Frames are the key frames of one vehicle; images are
undistorted.
"""

import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel

from calibgraph.arrays import Array
from calibgraph.errors import DatasetError, FileError
from calibgraph.files import checked_model, read_text
from calibgraph.io.frame_files import FrameFiles, IncompleteCamera, PublishedFolder
from calibgraph.io.lenses import intrinsics_of_matrix
from calibgraph.io.rig_parts import pose_of_quaternion
from calibgraph.model.geometry import invert
from calibgraph.model.rig import Camera, Finite

Record = TypeVar("Record", bound="_Record")

LIDAR = "LIDAR_TOP"
_MATRIX_ROWS, _KEPT_TABLES = 3, 2
_Triple = tuple[Finite, Finite, Finite]


class _Record(BaseModel):
    token: str


class _CalibratedSensor(_Record):
    """The pose of a sensor in ego, and a camera's matrix."""

    sensor_token: str
    translation: _Triple
    rotation: tuple[Finite, Finite, Finite, Finite]  # w x y z
    camera_intrinsic: tuple[_Triple, ...] = ()

    def matrix(self, where: Path) -> Array:
        """(4, 4), from the sensor's coordinates."""
        w, x, y, z = self.rotation
        try:
            return pose_of_quaternion(self.translation, (x, y, z, w))
        except ValueError as error:
            raise FileError(where, f"record {self.token}: {error}") from error


class _Sensor(_Record):
    channel: str
    modality: Literal["camera", "lidar", "radar"]


class _Sample(_Record):
    timestamp: int  # [us]
    scene_token: str


class _Scene(_Record):
    name: str


class _SampleData(_Record):
    sample_token: str
    calibrated_sensor_token: str
    filename: str
    width: int | None = None
    height: int | None = None


@dataclass(frozen=True)
class _Instant:
    """A sample, with its images and its scan by channel."""

    stamp_us: int
    scene: str
    taken: Mapping[str, _SampleData]


@dataclass(frozen=True, eq=False)
class _Tables:
    """The samples of a nuScenes folder, or of one of its scenes."""

    folder: Path
    instants: tuple[_Instant, ...]
    cameras: tuple[str, ...]
    calibrated: Mapping[str, _CalibratedSensor]

    def with_scan(self, path: Path) -> list[_Instant]:
        """The samples with a scan; the path is for errors."""
        found = [each for each in self.instants if LIDAR in each.taken]
        if not found:
            raise FileError(path, _describe_no_scan(self))
        return found

    def calibration_of(self, taken: _SampleData) -> _CalibratedSensor:
        """The pose of the sensor that took an image or a scan."""
        return self.calibrated[taken.calibrated_sensor_token]


def nuscenes(path: Path) -> PublishedFolder | None:
    """A folder, its tables, or a scene of them; None if a path is none."""
    if _find_tables(path) is None:
        return None

    def cameras() -> Sequence[str]:
        tables = _read_tables(path)
        _require_one_rig(path, tables)
        return tables.cameras

    def frames(names: Sequence[str]) -> list[FrameFiles]:
        tables = _read_tables(path)
        root = tables.folder.parent
        return [
            FrameFiles(
                str(each.stamp_us),
                root / each.taken[LIDAR].filename,
                {name: root / each.taken[name].filename for name in names if name in each.taken},
            )
            for each in tables.with_scan(path)
        ]

    return PublishedFolder(LIDAR, cameras, lambda name: _camera(path, name), frames)


def _camera(path: Path, name: str) -> Camera:
    tables = _read_tables(path)
    instants = tables.with_scan(path)
    taken = {name: one for each in reversed(instants) for name, one in each.taken.items()}
    if name not in taken:
        raise IncompleteCamera(path, f"has no key frame of {name}")
    where = tables.folder / "calibrated_sensor.json"
    sensor = tables.calibration_of(taken[name])
    K = np.array(sensor.camera_intrinsic)
    if len(K) != _MATRIX_ROWS:
        raise IncompleteCamera(where, f"record {sensor.token} of a camera has no camera_intrinsic")
    T_ego_lidar = tables.calibration_of(taken[LIDAR]).matrix(where)
    content = {
        "width_px": taken[name].width,
        "height_px": taken[name].height,
        "intrinsics_px": intrinsics_of_matrix(K, f"{where}: {sensor.token}: camera_intrinsic"),
        "T_camera_lidar": invert(sensor.matrix(where)) @ T_ego_lidar,
    }
    return checked_model(Camera, content, f"{where}: {sensor.token}")


def _require_one_rig(path: Path, tables: _Tables) -> None:
    """Check that all scenes have the same sensors at the same poses."""
    instants = tables.with_scan(path)
    for name in (LIDAR, *tables.cameras):
        scenes: dict[str, dict[str, None]] = {}  # by what the sensor's record holds
        for each in instants:
            if name in each.taken:
                record = tables.calibration_of(each.taken[name]).model_dump(exclude={"token"})
                scenes.setdefault(str(record), {})[each.scene] = None
        if len(scenes) > 1:
            groups = "; ".join(", ".join(each) for each in scenes.values())
            raise DatasetError(
                f"{path}: its scenes have {len(scenes)} calibrations of {name} ({groups}); name "
                f"scenes of one, as {path / instants[0].scene}"
            )


def _find_tables(path: Path) -> tuple[Path, str | None] | None:
    """The folder of the tables, and the scene if the path names one; None if there are none."""
    folder, scene = (path, None) if path.exists() else (path.parent, path.name)
    if (folder / "sample_data.json").is_file():
        return folder, scene
    found = sorted(each.parent for each in folder.glob("v1.0-*/sample_data.json"))
    if len(found) > 1:
        names = ", ".join(each.name for each in found)
        raise FileError(folder, f"has the versions {names}; name one: {found[0]}")
    return (found[0], scene) if found else None


def _read_tables(path: Path) -> _Tables:
    folder, scene = _find_tables(path) or (path, None)
    whole = _read_all(folder, (folder / "sample_data.json").stat().st_mtime_ns)
    if scene is None:
        return whole
    instants = tuple(each for each in whole.instants if each.scene == scene)
    if not instants:
        names = ", ".join(sorted({each.scene for each in whole.instants}))
        raise FileError(path, f"no such scene; the tables have {names}")
    return replace(whole, instants=instants)


@lru_cache(_KEPT_TABLES)
def _read_all(folder: Path, _changed_ns: int) -> _Tables:
    samples = _by_token(folder, "sample", _Sample)
    scenes = _by_token(folder, "scene", _Scene)
    sensors = _by_token(folder, "sensor", _Sensor)
    calibrated = _by_token(folder, "calibrated_sensor", _CalibratedSensor)
    taken: dict[str, dict[str, _SampleData]] = defaultdict(dict)
    try:
        for each in _by_token(folder, "sample_data", _SampleData, only="is_key_frame").values():
            sensor = sensors[calibrated[each.calibrated_sensor_token].sensor_token]
            taken[each.sample_token][sensor.channel] = each
        instants = [
            _Instant(samples[token].timestamp, scenes[samples[token].scene_token].name, channels)
            for token, channels in taken.items()
        ]
    except KeyError as error:
        raise FileError(folder, f"its tables have no record {error}; are they complete?") from error
    cameras = sorted(each.channel for each in sensors.values() if each.modality == "camera")
    instants.sort(key=lambda each: each.stamp_us)
    return _Tables(folder, tuple(instants), tuple(cameras), calibrated)


def _describe_no_scan(tables: _Tables) -> str:
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


def _by_token(
    folder: Path, table: str, model: type[Record], *, only: str | None = None
) -> dict[str, Record]:
    """The records of a table; of a large one, those with a field set."""
    path = folder / f"{table}.json"
    records = (each for each in _read_list(path) if only is None or each.get(only))
    return {each.token: each for each in (checked_model(model, r, path) for r in records)}


def _read_list(path: Path) -> list[dict[str, Any]]:
    try:
        content = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise FileError(path, f"is no JSON ({error}); is it complete?") from error
    if not isinstance(content, list) or not all(isinstance(each, dict) for each in content):
        raise FileError(path, "is no table of nuScenes; expected a list of records")
    return content
