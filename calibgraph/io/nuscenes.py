"""nuScenes folders: tables of records tied by tokens, read as far as they are needed.

A sample_data (an image or a scan) is of one sample (an instant), and has a calibrated_sensor (the
pose of its sensor in the vehicle, ego). Frames are the key frames of one vehicle; images are
undistorted.
"""

import json
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel

from calibgraph.arrays import Array
from calibgraph.errors import DatasetError, FileError
from calibgraph.files import checked_model, read_text
from calibgraph.io.frame import Frame
from calibgraph.io.lenses import intrinsics_of_matrix
from calibgraph.io.published import PublishedFolder
from calibgraph.io.rig_parts import IncompleteCamera, pose_of_quaternion
from calibgraph.model.geometry import invert
from calibgraph.model.rig import Camera, Finite

LIDAR = "LIDAR_TOP"
_KEPT_TABLES = 2
_Triple = tuple[Finite, Finite, Finite]


class _Taken(BaseModel):
    """A key frame of a sensor: its sample_data, with the records that its tokens name."""

    stamp_us: int
    scene: str
    channel: str
    modality: Literal["camera", "lidar", "radar"]
    filename: str
    width: int | None
    height: int | None
    sensor: str
    translation: _Triple
    rotation: tuple[Finite, Finite, Finite, Finite]  # w x y z
    camera_intrinsic: tuple[_Triple, ...] = ()

    def T_ego_sensor(self, where: Path) -> Array:
        """(4, 4); the path is for errors."""
        w, x, y, z = self.rotation
        try:
            return pose_of_quaternion(self.translation, (x, y, z, w))
        except ValueError as error:
            raise FileError(where, f"record {self.sensor}: {error}") from error


_Instants = list[dict[str, _Taken]]
"""The key frames of each sample, by channel, in order of time."""


def nuscenes(path: Path) -> PublishedFolder | None:
    """A folder, its tables, or a scene of them; None if a path is none."""
    if _find_tables(path) is None:
        return None

    def cameras() -> Sequence[str]:
        _, names, instants = _read_tables(path)
        _require_one_rig(path, (LIDAR, *names), instants)
        return names

    def frames(names: Sequence[str]) -> list[Frame]:
        folder, _, instants = _read_tables(path)
        return [
            Frame(
                n,
                str(taken[LIDAR].stamp_us),
                folder.parent / taken[LIDAR].filename,
                {n: folder.parent / taken[n].filename for n in names if n in taken},
            )
            for n, taken in enumerate(instants)
        ]

    return PublishedFolder(
        lambda: {"lidar": LIDAR}, cameras, lambda name: _camera(path, name), frames
    )


def _camera(path: Path, name: str) -> Camera:
    folder, _, instants = _read_tables(path)
    taken = next((each[name] for each in instants if name in each), None)
    if taken is None:
        raise IncompleteCamera(path, f"has no key frame of {name}")
    where = folder / "calibrated_sensor.json"
    if not taken.camera_intrinsic:
        raise IncompleteCamera(where, f"record {taken.sensor} of a camera has no camera_intrinsic")
    K, said = taken.camera_intrinsic, f"{where}: {taken.sensor}"
    content = {
        "width_px": taken.width,
        "height_px": taken.height,
        "intrinsics_px": intrinsics_of_matrix(K, f"{said}: camera_intrinsic"),
        "T_camera_lidar": invert(taken.T_ego_sensor(where))
        @ instants[0][LIDAR].T_ego_sensor(where),
    }
    return checked_model(Camera, content, said)


def _require_one_rig(path: Path, channels: Sequence[str], instants: _Instants) -> None:
    """Check that all scenes have the same sensors at the same poses."""
    for name in channels:
        scenes: dict[Any, dict[str, None]] = {}  # by what the sensor's record holds
        for taken in (each[name] for each in instants if name in each):
            record = taken.translation, taken.rotation, taken.camera_intrinsic
            scenes.setdefault(record, {})[taken.scene] = None
        if len(scenes) > 1:
            groups = "; ".join(", ".join(each) for each in scenes.values())
            raise DatasetError(
                f"{path}: its scenes have {len(scenes)} calibrations of {name} ({groups}); name "
                f"scenes of one, as {path / instants[0][LIDAR].scene}"
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


def _read_tables(path: Path) -> tuple[Path, list[str], _Instants]:
    """The tables' folder, its cameras, and the instants with a scan, of its scene or all."""
    folder, scene = _find_tables(path) or (path, None)
    cameras, whole = _read_all(folder, (folder / "sample_data.json").stat().st_mtime_ns)
    instants = [each for each in whole if scene in (None, next(iter(each.values())).scene)]
    if whole and not instants:
        names = ", ".join(sorted({one.scene for each in whole for one in each.values()}))
        raise FileError(path, f"no such scene; the tables have {names}")
    scanned = [each for each in instants if LIDAR in each]
    if not scanned:
        raise FileError(path, f"has no key frame of {LIDAR}; no other scans are read")
    return folder, cameras, scanned


@lru_cache(_KEPT_TABLES)
def _read_all(folder: Path, _changed_ns: int) -> tuple[list[str], _Instants]:
    sensors, calibrated, samples, scenes = (
        {str(each.get("token")): each for each in _read_list(folder / f"{table}.json")}
        for table in ("sensor", "calibrated_sensor", "sample", "scene")
    )
    instants: dict[str, dict[str, _Taken]] = {}
    for each in _read_list(folder / "sample_data.json"):
        if not each.get("is_key_frame"):
            continue
        try:
            pose = calibrated[each["calibrated_sensor_token"]]
            sensor, sample = sensors[pose["sensor_token"]], samples[each["sample_token"]]
            scene = scenes[sample["scene_token"]]
        except (KeyError, TypeError) as error:
            raise FileError(
                folder, f"its tables have no record {error}; are they complete?"
            ) from error
        content = {
            **sensor, **pose, **dict.fromkeys(("width", "height")), **each,
            "stamp_us": sample.get("timestamp"), "scene": scene.get("name"),
            "sensor": pose["token"],
        }  # fmt: skip
        taken = checked_model(_Taken, content, folder / f"sample_data.json: {each.get('token')}")
        instants.setdefault(each["sample_token"], {})[taken.channel] = taken
    cameras = sorted(
        f"{each.get('channel')}" for each in sensors.values() if each.get("modality") == "camera"
    )
    return cameras, sorted(instants.values(), key=lambda each: next(iter(each.values())).stamp_us)


def _read_list(path: Path) -> list[dict[str, Any]]:
    try:
        content = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise FileError(path, f"is no JSON ({error}); is it complete?") from error
    if not isinstance(content, list) or not all(isinstance(each, dict) for each in content):
        raise FileError(path, "is no table of nuScenes; expected a list of records")
    return content
