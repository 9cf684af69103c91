"""nuScenes folders: the rig of calibrated_sensor, and the key frames of one vehicle."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import DatasetError, FileError
from calibgraph.files import checked_model
from calibgraph.io.frame_files import FrameFiles, IncompleteCamera, RigRead, rig_of_complete
from calibgraph.io.lenses import intrinsics_of_matrix
from calibgraph.io.nuscenes_tables import (
    LIDAR,
    Instant,
    SampleData,
    Tables,
    describe_no_scan,
    find_tables,
    read_ego_poses,
    read_tables,
)
from calibgraph.model.geometry import invert
from calibgraph.model.rig import Camera

_MATRIX_ROWS = 3


def is_nuscenes(path: Path | str) -> bool:
    """Whether a path is a nuScenes folder, its tables, or a scene of them."""
    return find_tables(Path(path)) is not None


def read_nuscenes_rig(path: Path) -> RigRead:
    """The rig of a nuScenes folder or scene: T_camera_lidar through ego; images are undistorted."""
    tables = read_tables(path)
    instants = [each for each in tables.instants if LIDAR in each.taken]
    if not instants:
        raise FileError(path, describe_no_scan(tables))
    _require_one_rig(path, tables, instants)
    taken = {name: one for each in reversed(instants) for name, one in each.taken.items()}
    where = tables.folder / "calibrated_sensor.json"
    T_ego_lidar = tables.calibration_of(taken[LIDAR]).matrix(where)

    def read(name: str) -> Camera:
        if name not in taken:
            raise IncompleteCamera(path, f"has no key frame of {name}")
        return _camera(tables, taken[name], T_ego_lidar, where)

    return rig_of_complete(LIDAR, tables.cameras, read, path)


def _camera(tables: Tables, taken: SampleData, T_ego_lidar: Array, where: Path) -> Camera:
    sensor = tables.calibration_of(taken)
    K = np.array(sensor.camera_intrinsic)
    if len(K) != _MATRIX_ROWS:
        raise IncompleteCamera(where, f"record {sensor.token} of a camera has no camera_intrinsic")
    content = {
        "width_px": taken.width,
        "height_px": taken.height,
        "intrinsics_px": intrinsics_of_matrix(K, f"{where}: {sensor.token}: camera_intrinsic"),
        "T_camera_lidar": invert(sensor.matrix(where)) @ T_ego_lidar,
    }
    return checked_model(Camera, content, f"{where}: {sensor.token}")


def _require_one_rig(path: Path, tables: Tables, instants: list[Instant]) -> None:
    """Check that all scenes have the same sensors at the same poses."""
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


def nuscenes_frames(path: Path, cameras: Sequence[str]) -> list[FrameFiles]:
    """The samples, in order of time; their stems are their stamps."""
    tables = read_tables(path)
    root = tables.folder.parent
    frames = [
        FrameFiles(
            str(each.stamp_us),
            root / each.taken[LIDAR].filename,
            {name: root / each.taken[name].filename for name in cameras if name in each.taken},
        )
        for each in tables.instants
        if LIDAR in each.taken
    ]
    if not frames:
        raise FileError(path, describe_no_scan(tables))
    return frames


def describe_motion(path: Path) -> str:
    """How far the vehicle moves between scans and images, in a line; empty without ego_pose."""
    tables = read_tables(path)
    poses = read_ego_poses(tables)
    if not poses:
        return ""
    moved = [
        max(_apart_m(poses, each.taken[LIDAR], each.taken[name])
            for name in tables.cameras if name in each.taken)
        for each in tables.instants
        if LIDAR in each.taken and any(name in each.taken for name in tables.cameras)
    ]  # fmt: skip
    return (
        f"{path}: the vehicle moves {np.median(moved):.2f} m (median), at most "
        f"{np.max(moved):.2f} m, between a scan and its images"
    )


def _apart_m(poses: dict[str, Array], one: SampleData, other: SampleData) -> float:
    both = [poses.get(each.ego_pose_token) for each in (one, other)]
    if both[0] is None or both[1] is None:
        return 0.0
    return float(np.linalg.norm(both[0][:3, 3] - both[1][:3, 3]))
