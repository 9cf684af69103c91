"""Clouds from disk: what is incomplete or no cloud is refused by name."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather

from calibgraph import FileError
from calibgraph.io import clouds
from calibgraph.io.clouds import load_cloud, read_cloud_notes
from calibgraph.io.frame import Frame
from tests.io.kitti_files import CLOUD


def test_npy_and_bin_clouds_are_read(tmp_path: Path) -> None:
    np.save(tmp_path / "four.npy", CLOUD)
    np.save(tmp_path / "three.npy", CLOUD[:, :3].astype(np.float64))
    CLOUD.tofile(tmp_path / "four.bin")
    np.testing.assert_array_equal(load_cloud(tmp_path / "four.npy"), CLOUD)
    np.testing.assert_array_equal(load_cloud(tmp_path / "four.bin"), CLOUD)
    three = load_cloud(tmp_path / "three.npy")
    np.testing.assert_array_equal(three[:, :3], CLOUD[:, :3])
    assert np.isnan(three[:, 3]).all()


@pytest.mark.parametrize("nothing", [np.nan, 0.0])
@pytest.mark.parametrize("suffix", [".npy", ".bin", ".feather"])
def test_points_without_a_return_are_left_out(suffix: str, nothing: float, tmp_path: Path) -> None:
    organised, path = CLOUD.astype(np.float64), tmp_path / f"cloud{suffix}"
    organised[np.random.default_rng(0).choice(500, 100, replace=False), :3] = nothing
    if suffix == ".npy":
        np.save(path, organised)
    elif suffix == ".bin":
        organised.astype("<f4").tofile(path)
    else:
        columns = dict(zip(("x", "y", "z", "Intensity"), organised.T, strict=True))
        feather.write_feather(pa.table(columns), path)
    assert len(load_cloud(path)) == 400


def test_bad_clouds_are_named(tmp_path: Path) -> None:
    good = tmp_path / "good.npy"
    np.save(good, CLOUD)
    partly = CLOUD.copy()
    partly[7, 1] = np.inf
    np.save(tmp_path / "infinite.npy", partly)
    np.save(tmp_path / "flat.npy", CLOUD.ravel())
    np.save(tmp_path / "text.npy", np.array(["a", "b"]))
    np.save(tmp_path / "objects.npy", np.array([{}, None], dtype=object), allow_pickle=True)
    np.save(tmp_path / "nothing.npy", np.full((3, 4), np.nan))
    (tmp_path / "truncated.npy").write_bytes(good.read_bytes()[:-100])
    (tmp_path / "empty.npy").write_bytes(b"")
    (tmp_path / "odd.bin").write_bytes(b"12345")
    (tmp_path / "empty.bin").write_bytes(b"")
    np.savez(tmp_path / "archive.npz", CLOUD)
    (tmp_path / "archive.npz").rename(tmp_path / "archive.npy")
    np.save(tmp_path / "transposed.npy", np.tile(CLOUD, (20, 1)).T)
    np.save(tmp_path / "origin.npy", np.zeros((100, 4)))
    for path in sorted(set(tmp_path.iterdir()) - {good}):
        with pytest.raises(FileError, match=path.name) as caught:
            load_cloud(path)
        assert "\n" not in str(caught.value)
    with pytest.raises(FileError, match=r"point 7 is not finite"):
        load_cloud(tmp_path / "infinite.npy")


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f4', 'fortran_order': False, 'shape': (100000000000, 4), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (-5, 4), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (1" + "0" * 400 + ", 4), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': " + "-" * 9000 + "1, }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': " + "[" * 4000 + "]" * 4000 + ", }",
        "{" * 9000,
        None,
    ],
)
def test_a_hostile_npy_header_is_one_line(header: str | None, tmp_path: Path) -> None:
    path = tmp_path / "cloud.npy"
    written = (header or "").encode() + b"\n"
    start = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(written))
    path.write_bytes((start + written if header else b"PK\x03\x04") + bytes(64))
    with pytest.raises(FileError, match="cannot be read as a .npy array") as caught:
        load_cloud(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("shape", [(500, 3), (499, 4), (250, 4)])
def test_an_npy_header_that_claims_less_than_there_is_scrambles_no_points(
    shape: tuple[int, int], tmp_path: Path
) -> None:
    np.save(tmp_path / "cloud.npy", CLOUD)
    data = (tmp_path / "cloud.npy").read_bytes()
    (tmp_path / "cloud.npy").write_bytes(data.replace(b"(500, 4)", str(shape).encode()))
    with pytest.raises(FileError, match=r"goes on after the \(\d+, \d\) numbers"):
        load_cloud(tmp_path / "cloud.npy")


def pcd(fields: str, size: str = "4 4 4 4", count: str = "1 1 1 1") -> bytes:
    header = f"""VERSION 0.7
FIELDS {fields}
SIZE {size}
TYPE F F F F
COUNT {count}
WIDTH 500
HEIGHT 1
POINTS 500
DATA binary
"""
    return header.encode() + CLOUD.tobytes()


def ply(*properties: str) -> bytes:
    lines = "".join(f"property float {name}\n" for name in properties)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex 500\n{lines}end_header\n"
    return header.encode() + CLOUD.tobytes()


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("no_x.ply", ply("a", "y", "z", "intensity"), "fields a y z intensity, expected one x"),
        ("no_z.ply", ply("x", "y", "intensity"), "expected one z"),
        ("two_x.ply", ply("x", "x", "y", "z"), "expected one x"),
        ("no_y.pcd", pcd("x a z intensity"), "expected one y"),
        ("negative.pcd", pcd("x y z intensity", count="1 1 1 -1"), "found '-1'"),
        ("negative_x.pcd", pcd("x y z intensity", count="-1 1 1 1"), "found '-1'"),
        ("wide_x.pcd", pcd("x y z intensity", count="2 1 1 1"), "expected one x"),
        ("sizes.pcd", pcd("x y z intensity", size="4 4 4"), "malformed"),
        ("coded.pcd", pcd("x y z intensity").replace(b"binary", b"gzip"), "unknown encoding"),
        ("coded.ply", ply("x", "y", "z", "a").replace(b"_little", b"_middle"), "unknown encoding"),
        (
            "many.ply",
            ply("x", "y", "z", "a").replace(b"500", b"9" * 5000),
            "malformed PLY header, at .element vertex 999",
        ),
        ("wide.pcd", pcd("x y z intensity").replace(b"WIDTH 500", b"WIDTH 7"), "do not fit"),
        ("odd.pcd", pcd("x y z intensity", size="4 4 3 5"), "do not fit"),
    ],
)
def test_malformed_headers_are_refused(
    name: str, data: bytes, message: str, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(FileError, match=message):
        load_cloud(path)


@pytest.mark.parametrize("largest", [1e9, 1e37])
def test_coordinates_that_are_no_metres_are_named_with_the_cloud(
    largest: float, tmp_path: Path
) -> None:
    far = CLOUD.copy()
    far[3, 1] = -largest
    np.save(tmp_path / "far.npy", far)
    with pytest.raises(FileError, match=r"far.npy: holds a coordinate of 1e\+\d+, expected metres"):
        load_cloud(tmp_path / "far.npy")


def test_random_bytes_are_refused_without_a_warning(tmp_path: Path) -> None:
    """Warnings are errors here; signalling NaNs are numbers that cause some."""
    data = np.random.default_rng(0).integers(0, 256, 16 * 50_000, np.uint8)
    (tmp_path / "random.bin").write_bytes(data.tobytes())
    with pytest.raises(FileError, match="random.bin: its columns cannot be told by its content"):
        load_cloud(tmp_path / "random.bin")


@pytest.mark.parametrize("kind", ["packed", "half", "infinite"])
def test_an_intensity_of_another_field_is_left_out_with_a_note(kind: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    cloud, path = np.tile(CLOUD, (20, 1)), tmp_path / "cloud.npy"
    if kind == "packed":  # colours
        cloud[:, 3] = rng.integers(0, 2**32, len(cloud), dtype=np.uint32).view(np.float32)
    else:
        cloud[:: 2 if kind == "half" else len(cloud), 3] = np.nan if kind == "half" else np.inf
    np.save(path, cloud)
    left_out = kind != "infinite"  # at one point
    assert np.isnan(load_cloud(path)[:, 3]).all() == left_out
    notes = [note for note in read_cloud_notes(path) if "it is none, and is left out" in note]
    assert len(notes) == left_out


def test_points_without_a_return_may_have_no_intensity(tmp_path: Path) -> None:
    cloud, path = np.tile(CLOUD, (20, 1)), tmp_path / "cloud.npy"
    cloud[::2] = np.nan
    np.save(path, cloud)
    assert np.isfinite(load_cloud(path)[:, 3]).all()
    assert not any("left out" in note for note in read_cloud_notes(path))


def test_a_feather_file_that_states_more_than_it_can_hold_is_refused(tmp_path: Path) -> None:
    zeros = np.zeros(10_000_000, np.float32)
    for packing in ("zstd", "lz4"):
        path = tmp_path / f"{packing}.feather"
        feather.write_feather(pa.table(dict.fromkeys("xyz", zeros)), path, compression=packing)
        with pytest.raises(FileError, match="states 120 MB in .* points do not pack so"):
            load_cloud(path)


def test_only_clouds_of_more_points_than_are_used_are_thinned(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """At random, the same each time, in order; the rest is bit-equal."""
    monkeypatch.setattr(clouds, "MOST_POINTS", 100)
    cloud = np.arange(4 * 300, dtype=np.float32).reshape(300, 4) + 1
    assert clouds.thin_cloud(cloud[:100]).base is cloud
    np.save(tmp_path / "0.npy", cloud)
    frame = Frame(0, "0", tmp_path / "0.npy", {})
    thinned = frame.load_cloud()
    np.testing.assert_array_equal(thinned, frame.load_cloud())
    rows = ((thinned[:, 0] - 1) / 4).astype(int)
    np.testing.assert_array_equal(thinned, cloud[rows])
    assert len(set(rows)) == 100 and (np.diff(rows) > 0).all() and 120 < rows.mean() < 180
    (line,) = clouds.describe_thinned([99, 100])
    assert line.startswith("1 of 2 clouds have 100 points or more")
    assert not clouds.describe_thinned([99])
