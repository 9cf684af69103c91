"""Clouds and data sets as others write them: .pcd, .ply, KITTI, nuScenes."""

import json
import shutil
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibgraph import Dataset
from calibgraph.model.geometry import transform
from tests.conftest import make_camera

CLOUD = np.random.default_rng(0).normal(0, (20, 10, 1), (500, 3))
CLOUD = np.column_stack([CLOUD, np.random.default_rng(1).integers(1, 256, 500) / 256])
CLOUD = CLOUD.astype(np.float32)


def written_kitti(folder: Path, frames: int = 2) -> Path:
    """A KITTI odometry sequence with two cameras and known numbers."""
    (folder / "velodyne").mkdir(parents=True)
    K = np.array([[700.0, 0, 600], [0, 700, 180], [0, 0, 1]])
    lines = []
    for k in range(4):
        b = np.array([[-0.5 * k], [0.01 * k], [0.002 * k]])
        lines.append(f"P{k}: " + " ".join(map(str, (K @ np.hstack([np.eye(3), b])).ravel())))
    Tr = np.hstack([make_camera((0.27, 0.0, -0.08)).T_camera_lidar[:3]])
    lines.append("Tr: " + " ".join(map(str, Tr.ravel())))
    (folder / "calib.txt").write_text("\n".join(lines))
    for k in (2, 3):
        (folder / f"image_{k}").mkdir()
        for i in range(frames):
            image = np.full((370, 1226, 3), 40 * k, np.uint8)
            cv2.imwrite(str(folder / f"image_{k}" / f"{i:06}.png"), image)
    for i in range(frames):
        CLOUD.tofile(folder / "velodyne" / f"{i:06}.bin")
    return folder


RECTIFY = Rotation.from_euler("xyz", [0.4, -0.3, 0.5], degrees=True).as_matrix()

T_CAMERA0_LIDAR = make_camera((0.27, 0.0, -0.08), yaw_deg=0.5).T_camera_lidar

BASELINES = {"02": [0.06, 0.001, 0.003], "03": [-0.47, 0.002, 0.003]}


def text_of(name: str, values: np.ndarray) -> str:
    return f"{name}: " + " ".join(f"{value:.15e}" for value in np.ravel(values))


R_EGO_LIDAR = Rotation.from_euler("z", -90, degrees=True)  # x to the right
T_EGO_LIDAR = transform(R_EGO_LIDAR, [0.94, 0.0, 1.84])
START_US, PERIOD_US = 1_532_402_927_000_000, 500_000
Tables = dict[str, list[dict[str, Any]]]


def pose(T: np.ndarray) -> dict[str, Any]:
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    return {"translation": T[:3, 3].tolist(), "rotation": [w, x, y, z]}


def tables_of(data: Dataset, *, scene: str = "scene-0001") -> Tables:
    """The tables of a scene."""
    sensors = {"LIDAR_TOP": "lidar", **dict.fromkeys(data.rig.cameras, "camera"), "RADAR": "radar"}
    poses = {"LIDAR_TOP": T_EGO_LIDAR, "RADAR": np.eye(4)}
    for name, camera in data.rig.cameras.items():
        poses[name] = T_EGO_LIDAR @ np.linalg.inv(camera.T_camera_lidar)
    tables: Tables = {
        "sensor": [
            {"token": f"s-{name}", "channel": name, "modality": kind}
            for name, kind in sensors.items()
        ],
        "calibrated_sensor": [
            {
                "token": f"{scene}-{name}", "sensor_token": f"s-{name}", **pose(T),
                "camera_intrinsic": data.rig.cameras[name].matrix_px.tolist()
                if name in data.rig.cameras else [],
            }
            for name, T in poses.items()
        ],
        "scene": [{"token": scene, "name": scene, "log_token": "log"}],
        "sample": [], "sample_data": [],
    }  # fmt: skip
    for number, frame in enumerate(data.frames):
        stamp, sample = START_US + number * PERIOD_US, f"{scene}-{number}"
        tables["sample"].append({"token": sample, "timestamp": stamp, "scene_token": scene})
        files = {"LIDAR_TOP": f"{sample}.pcd.bin", "RADAR": f"{sample}.pcd"}
        files |= {name: f"{sample}{path.suffix}" for name, path in frame.image_paths.items()}
        for name, file in files.items():
            camera = data.rig.cameras.get(name)
            record = {
                "sample_token": sample,
                "calibrated_sensor_token": f"{scene}-{name}", "timestamp": stamp,
                "filename": f"samples/{name}/{file}", "fileformat": "pcd",
                "width": camera.width_px if camera else 0,
                "height": camera.height_px if camera else 0,
            }  # fmt: skip
            sweep = {"token": f"{sample}-{name}-sweep", "is_key_frame": False, **record}
            tables["sample_data"] += [
                {"token": f"{sample}-{name}-data", "is_key_frame": True, **record},
                {**sweep, "filename": f"sweeps/{name}/{file}"},
            ]
    return tables


def write_files(folder: Path, data: Dataset) -> None:
    """Scans of x y z intensity ring, and images."""
    for number, frame in enumerate(data.frames):
        scan = folder / "samples" / "LIDAR_TOP" / f"scene-0001-{number}.pcd.bin"
        scan.parent.mkdir(parents=True, exist_ok=True)
        cloud = frame.load_cloud()
        ring = np.arange(len(cloud), dtype=np.float32) % 32
        np.column_stack([cloud, ring]).astype("<f4").tofile(scan)
        for name, path in frame.image_paths.items():
            image = folder / "samples" / name / f"scene-0001-{number}{path.suffix}"
            image.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, image)


def write_tables(folder: Path, *parts: Tables) -> None:
    """Write the tables; records of several scenes one after another, sensors once."""
    (folder / "v1.0-mini").mkdir(parents=True, exist_ok=True)
    for table in parts[0]:
        records = {each["token"]: each for part in parts for each in part[table]}
        (folder / "v1.0-mini" / f"{table}.json").write_text(json.dumps(list(records.values())))


def pcd(encoding: str = "binary", *, padding: bool = False) -> bytes:
    """CLOUD as PCL writes it: with padding, as a PointXYZI in memory."""
    rows = padded() if padding else fields_of(CLOUD)
    return pcd_of(rows, encoding)


def fields_of(cloud: NDArray[np.float32]) -> NDArray[np.void]:
    """(n,) x, y, z, intensity of a cloud."""
    rows = np.zeros(len(cloud), [(name, "<f4") for name in ("x", "y", "z", "intensity")])
    for column, name in enumerate(rows.dtype.names or ()):
        rows[name] = cloud[:, column]
    return rows


def padded() -> NDArray[np.void]:
    """(n,) CLOUD with padding of 4 and 12 bytes; names after the first underscore are cut."""
    kind = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("_0", "u1", 4), ("intensity", "<f4"),
            ("_1", "u1", 12)]  # fmt: skip
    rows = np.zeros(len(CLOUD), kind)
    for column, name in enumerate(("x", "y", "z", "intensity")):
        rows[name] = CLOUD[:, column]
    rows["_0"], rows["_1"] = 0xA5, 0x5A  # as if from memory
    return rows


def pcd_of(rows: NDArray[np.void], encoding: str = "binary", points: int = 0) -> bytes:
    """The .pcd of a structured array; names that begin with _ are padding.

    Args:
        rows: (n,) fields, of several numbers each, too.
        encoding: of DATA.
        points: as the header states it; their number if 0.
    """
    names = rows.dtype.names or ()
    kinds = [rows.dtype[name] for name in names]
    count = points or len(rows)
    header = {
        "VERSION": ["0.7"],
        "FIELDS": ["_" if name.startswith("_") else name for name in names],
        "SIZE": [kind.base.itemsize for kind in kinds],
        "TYPE": [{"f": "F", "i": "I", "u": "U"}[kind.base.kind] for kind in kinds],
        "COUNT": [int(np.prod(kind.shape, dtype=int)) for kind in kinds],
        "WIDTH": [count], "HEIGHT": [1], "VIEWPOINT": [0, 0, 0, 1, 0, 0, 0], "POINTS": [count],
        "DATA": [encoding],
    }  # fmt: skip
    lines = "".join(f"{key} {' '.join(map(str, words))}\n" for key, words in header.items())
    return lines.encode() + _BODIES[encoding](rows)


def _text(rows: NDArray[np.void]) -> bytes:
    columns = [rows[name].reshape(len(rows), -1) for name in rows.dtype.names or ()]
    numbers = zip(*(column.tolist() for column in columns), strict=True)
    lines = (" ".join(repr(n) for part in row for n in part) for row in numbers)
    return "".join(f"{line}\n" for line in lines).encode()


def _packed(rows: NDArray[np.void]) -> bytes:
    plain = b"".join(rows[name].tobytes() for name in rows.dtype.names or ())
    packed = lzf_of_literals(plain)
    return struct.pack("<II", len(packed), len(plain)) + packed


def lzf_of_literals(data: bytes) -> bytes:
    """LZF that repeats nothing."""
    parts = [data[at : at + 32] for at in range(0, len(data), 32)]
    return b"".join(bytes([len(part) - 1]) + part for part in parts)


_BODIES = {
    "ascii": _text, "binary": lambda rows: rows.tobytes(), "binary_compressed": _packed,
}  # fmt: skip


PLY_NAMES = {"f4": "float", "f8": "double", "i1": "char", "u1": "uchar", "i2": "short",
             "u2": "ushort", "i4": "int", "u4": "uint"}  # fmt: skip


def ply_of(rows: NDArray[np.void], encoding: str, *, after: bytes = b"") -> bytes:
    """The .ply of a structured array, with elements after the vertices."""
    big = rows.astype(rows.dtype.newbyteorder(">")) if "big" in encoding else rows
    written = _text(rows) if encoding == "ascii" else big.tobytes()
    kinds = {name: PLY_NAMES[rows.dtype[name].str[1:]] for name in rows.dtype.names or ()}
    properties = "".join(f"property {kind} {name}\n" for name, kind in kinds.items())
    header = f"ply\nformat {encoding} 1.0\ncomment by hand\n".encode()
    header += f"element vertex {len(rows)}\n{properties}".encode() + after + b"end_header\n"
    return header + written


def ply(
    encoding: str = "binary_little_endian", *, after: bytes = b"",
    names: tuple[str, ...] = ("x", "y", "z", "intensity"),
) -> bytes:  # fmt: skip
    """CLOUD as .ply, with properties of these names."""
    data = ply_of(fields_of(CLOUD), encoding, after=after)
    header, end, own = data.partition(b"\nend_header\n")
    for old, new in zip(("x", "y", "z", "intensity"), names, strict=True):
        header = (header + b"\n").replace(f" {old}\n".encode(), f" ?{new}\n".encode(), 1)[:-1]
    return header.replace(b" ?", b" ") + end + own
