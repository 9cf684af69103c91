"""Clouds of PCL in every form that it writes, and no others."""

from __future__ import annotations

import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from calibgraph import FileError
from calibgraph.io.clouds import load_cloud, read_cloud
from calibgraph.io.pcd import unpack_lzf
from tests.io.written import CLOUD, fields_of, lzf_of_literals, padded, pcd, pcd_of, ply

ENCODINGS = ["ascii", "binary", "binary_compressed"]
OUSTER = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("_0", "u1", 4), ("intensity", "<f4"),
          ("t", "<u4"), ("reflectivity", "<u2"), ("ring", "u1"), ("_1", "u1"), ("ambient", "<u2"),
          ("_2", "u1", 2), ("range", "<u4"), ("_3", "u1", 12)]  # fmt: skip
NORMALS = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("_0", "u1", 4), ("normal_x", "<f4"),
           ("normal_y", "<f4"), ("normal_z", "<f4"), ("_1", "u1", 4), ("intensity", "<f4"),
           ("curvature", "<f4"), ("_2", "u1", 8)]  # fmt: skip
VELODYNE = [("rgb", "<u4"), ("fpfh", "<f4", 33), ("_0", "u1"), ("_1", "u1"), ("x", "<f8"),
            ("y", "<f8"), ("z", "<f8"), ("intensity", "<f8"), ("time", "<i8")]  # fmt: skip


def filled(kind: list[tuple[object, ...]]) -> NDArray[np.void]:
    rows = np.zeros(len(CLOUD), np.dtype(kind))  # type: ignore[arg-type]
    for number, name in enumerate(rows.dtype.names or ()):
        rows[name] = number + 1
    for column, name in enumerate(("x", "y", "z", "intensity")):
        rows[name] = CLOUD[:, column]
    return rows


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("rows", [padded(), filled(OUSTER), filled(NORMALS), filled(VELODYNE)])
def test_fields_of_any_type_count_and_padding_are_read_to_the_last_bit(
    rows: NDArray[np.void], encoding: str, tmp_path: Path
) -> None:
    path = tmp_path / "cloud.pcd"
    path.write_bytes(pcd_of(rows, encoding))
    np.testing.assert_array_equal(load_cloud(path), CLOUD)


@pytest.mark.parametrize("encoding", ["ascii", "binary_compressed"])
def test_padding_that_pcl_leaves_out_of_its_data_is_not_missed(
    encoding: str, tmp_path: Path
) -> None:
    header = pcd_of(padded(), encoding).split(b"DATA")[0]
    (tmp_path / "cloud.pcd").write_bytes(header + b"DATA" + pcd(encoding).split(b"DATA")[1])
    np.testing.assert_array_equal(load_cloud(tmp_path / "cloud.pcd"), CLOUD)


def lines_changed(data: bytes, old: bytes, new: bytes) -> bytes:
    assert old in data
    return data.replace(old, new, 1)


@pytest.mark.parametrize(
    "data",
    [
        b"# .PCD v0.7 - Point Cloud Data\n# FIELDS a b c\n" + pcd(),
        b"".join(line + b"\r\n" for line in pcd().split(b"\n")[:10])
        + b"\n".join(pcd().split(b"\n")[10:]),
        lines_changed(pcd(), b"VERSION 0.7", b"VERSION .5"),
        lines_changed(pcd(), b"VERSION 0.7\n", b""),
        lines_changed(pcd(), b"FIELDS", b"COLUMNS"),
        lines_changed(pcd(), b"COUNT 1 1 1 1\n", b""),
        lines_changed(pcd(), b"VIEWPOINT 0 0 0 1 0 0 0", b"VIEWPOINT 5 6 7 0 1 0 0"),
        lines_changed(pcd(), b"VIEWPOINT 0 0 0 1 0 0 0\n", b""),
        lines_changed(pcd(), b"WIDTH 500\nHEIGHT 1", b"WIDTH 25\nHEIGHT 20"),
        lines_changed(pcd(), b"POINTS 500\n", b""),
        lines_changed(pcd(), b"WIDTH 500\nHEIGHT 1\n", b""),
        lines_changed(pcd(), b"x y z intensity", b"X Y Z scalar_Intensity"),
        pcd() + b"\n",
        pcd("ascii").replace(b"\n", b"\r\n"),
        pcd("ascii") + b"\n \n",
    ],
)
def test_headers_of_other_writers_are_read(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "cloud.pcd").write_bytes(data)
    np.testing.assert_array_equal(load_cloud(tmp_path / "cloud.pcd"), CLOUD)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_points_without_a_return_are_left_out(encoding: str, tmp_path: Path) -> None:
    rows = fields_of(CLOUD)
    for axis in "xyz":
        rows[axis][::5] = np.nan
        rows[axis][1::5] = 0
    (tmp_path / "cloud.pcd").write_bytes(pcd_of(rows, encoding))
    kept = np.isin(np.arange(500) % 5, (2, 3, 4))
    np.testing.assert_array_equal(load_cloud(tmp_path / "cloud.pcd"), CLOUD[kept])


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_more_or_fewer_points_than_the_header_has_are_refused(
    encoding: str, tmp_path: Path
) -> None:
    path = tmp_path / "cloud.pcd"
    for points in (1, 499, 501, 10**9, 10**17):
        path.write_bytes(pcd_of(fields_of(CLOUD), encoding, points=points))
        with pytest.raises(FileError, match=r"cloud.pcd: (goes on|is truncated|its compressed)"):
            load_cloud(path)
    for kept in (1, 100, 300, 1000, -100):
        path.write_bytes(pcd_of(fields_of(CLOUD), encoding)[:kept])
        with pytest.raises(FileError, match=r"cloud.pcd"):
            load_cloud(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"FIELDS x y z intensity", b"FIELDS x y z", "malformed PCD header"),
        (b"TYPE F F F F", b"TYPE F F F Q", "do not fit"),
        (b"SIZE 4 4 4 4", b"SIZE 1 4 4 4", "do not fit"),
        (b"TYPE F F F F\n", b"", "malformed PCD header .'TYPE'"),
        (b"COUNT 1 1 1 1", b"COUNT 1 1 1 0", "do not fit"),
        (b"COUNT 1 1 1 1", b"COUNT 1 1 1 99999999999", "is truncated"),
        (b"WIDTH 500", b"WIDTH 5_00", "expected a number"),
        (b"DATA binary", b"DATA binary_lz4", "unknown encoding"),
        (b"DATA", b"DATE", "no complete .pcd header"),
    ],
)
def test_malformed_headers_are_named(old: bytes, new: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "cloud.pcd").write_bytes(lines_changed(pcd(), old, new))
    with pytest.raises(FileError, match=message):
        load_cloud(tmp_path / "cloud.pcd")


def test_lzf_is_unpacked_with_repeats_that_overlap() -> None:
    packed = np.frombuffer(b"\x02abc\x20\x02\xe0\x05\x00\x00z", np.uint8)
    unpacked = unpack_lzf(packed, 3 + 3 + 14 + 1)
    assert unpacked is not None
    assert unpacked.tobytes() == b"abcabc" + b"c" * 14 + b"z"


@pytest.mark.parametrize(
    "packed", [b"\x05abc", b"\x20\x00", b"\x00a\x20\x05", b"\x00a\xe0", b"\x00a\x20", b""]
)
def test_damaged_lzf_is_refused(packed: bytes) -> None:
    assert unpack_lzf(np.frombuffer(packed, np.uint8), 4) is None


def test_compressed_data_that_claim_more_than_they_can_hold_take_no_memory(tmp_path: Path) -> None:
    header, _ = pcd_of(fields_of(CLOUD), "binary_compressed", points=2**27).split(b"compressed\n")
    sizes = struct.pack("<II", 1000, 2**31)
    (tmp_path / "cloud.pcd").write_bytes(
        header + b"compressed\n" + sizes + lzf_of_literals(bytes(2000))
    )
    with pytest.raises(FileError, match="compressed data are not its 134217728 points"):
        load_cloud(tmp_path / "cloud.pcd")


@pytest.mark.parametrize(
    "name", ["Intensity", "scalar_Intensity", "REFLECTIVITY", "reflectance", "i", "intensities"]
)
def test_intensity_is_known_by_its_other_names(name: str, tmp_path: Path) -> None:
    (tmp_path / "cloud.pcd").write_bytes(
        lines_changed(pcd(), b"z intensity", b"z " + name.encode())
    )
    np.testing.assert_array_equal(load_cloud(tmp_path / "cloud.pcd"), CLOUD)
    assert read_cloud(tmp_path / "cloud.pcd").fields == ("x", "y", "z", name)


def test_clouds_are_read_without_open3d(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    for name, data in {"cloud.pcd": pcd(), "cloud.ply": ply()}.items():
        (tmp_path / name).write_bytes(data)
        np.testing.assert_array_equal(load_cloud(tmp_path / name), CLOUD)


def test_the_compressed_clouds_of_open3d_are_read(tmp_path: Path, open3d: Any) -> None:
    points = np.round(CLOUD, 1)  # repeats
    cloud = open3d.t.geometry.PointCloud(open3d.core.Tensor(points[:, :3].copy()))
    cloud.point["intensity"] = open3d.core.Tensor(points[:, 3:].copy())
    open3d.t.io.write_point_cloud(str(tmp_path / "cloud.pcd"), cloud, compressed=True)
    np.testing.assert_array_equal(load_cloud(tmp_path / "cloud.pcd"), points)
