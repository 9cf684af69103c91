"""Clouds from disk: any layout is read to the last bit; what is incomplete or no cloud is named."""

import io
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pyarrow import feather

from calibgraph import FileError, Rig, load_dataset
from calibgraph.io import clouds
from calibgraph.io.clouds import load_cloud, read_returns, unpack_lzf
from calibgraph.io.frame import Frame, frame_of_entry
from tests.conftest import SAMPLE, make_camera
from tests.io.written import CLOUD, fields_of, lzf_of_literals, padded, pcd, pcd_of, ply, ply_of

ENCODINGS = ["ascii", "binary", "binary_compressed"]
ORDERS = ["ascii", "binary_little_endian", "binary_big_endian"]
NUMBERS = ["<f4", "<f8", "<i1", "<u1", "<i2", "<u2", "<i4", "<u4"]
INTENSITIES = ["intensity", "Intensity", "scalar_Intensity", "REFLECTIVITY", "i", "remission"]
FACES = b"element face 2\nproperty list uchar int vertex_indices\nproperty float area\n"
NO_FACES = FACES.replace(b"face 2", b"face 0")


def expected_of(rows: NDArray[np.void]) -> NDArray[np.float32]:
    """(n, 4) by the fields' names."""
    names = {str(name).lower(): name for name in rows.dtype.names or ()}
    own = [names[name.lower()] for name in INTENSITIES if name.lower() in names]
    given = [rows[names[axis]] for axis in "xyz"]
    given.append(rows[own[0]] if own else np.full(len(rows), np.nan))
    return np.column_stack(given).astype(np.float32)


@st.composite
def layouts(draw: st.DrawFn, *, padding: bool) -> NDArray[np.void]:
    """Points with fields in any order and of any type, some of several numbers, some of padding."""
    fields: list[tuple[Any, ...]] = [(axis, draw(st.sampled_from(NUMBERS[:2]))) for axis in "xyz"]
    if draw(st.booleans()):
        fields.append((draw(st.sampled_from(INTENSITIES)), draw(st.sampled_from(NUMBERS))))
    for n in range(draw(st.integers(0, 3))):
        name = draw(st.sampled_from(["ring", "time"] + ["_"] * padding))
        shape = (draw(st.integers(1, 5)),) if padding and draw(st.booleans()) else ()
        kind = draw(st.sampled_from(NUMBERS)) if name != "_" else "u1"
        fields.append((f"{name}{n}", kind, *([shape] if shape else [])))
    rows = np.zeros(draw(st.integers(1, 40)), draw(st.permutations(fields)))
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    for name in rows.dtype.names or ():
        rows[name] = rng.integers(1, 120, rows[name].shape)
        if name in "xyz":
            rows[name] += (rng.integers(0, 256, len(rows)) / 256).astype(np.float32)
    return rows


def same_as_written(folder: Path, name: str, data: bytes, rows: NDArray[np.void]) -> None:
    (folder / name).write_bytes(data)
    np.testing.assert_array_equal(load_cloud(folder / name), expected_of(rows))


often = settings(
    max_examples=60, deadline=None, derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)  # fmt: skip


@often
@given(rows=layouts(padding=True), encoding=st.sampled_from(ENCODINGS))
def test_pcd_of_any_layout_is_read_to_the_last_bit(
    rows: NDArray[np.void], encoding: str, tmp_path: Path
) -> None:
    same_as_written(tmp_path, "cloud.pcd", pcd_of(rows, encoding), rows)


@often
@given(rows=layouts(padding=False), order=st.sampled_from(ORDERS), faces=st.booleans())
def test_ply_of_any_layout_is_read_to_the_last_bit(
    rows: NDArray[np.void], order: str, faces: bool, tmp_path: Path
) -> None:
    after = NO_FACES if faces else b""
    same_as_written(tmp_path, "cloud.ply", ply_of(rows, order, after=after), rows)


@often
@given(rows=layouts(padding=False))
def test_npy_of_any_fields_is_read_to_the_last_bit(rows: NDArray[np.void], tmp_path: Path) -> None:
    np.save(tmp_path / "cloud.npy", rows)
    np.testing.assert_array_equal(load_cloud(tmp_path / "cloud.npy"), expected_of(rows))


def changed(data: bytes, old: bytes, new: bytes) -> bytes:
    assert old in data
    return data.replace(old, new, 1)


HEAD = b"WIDTH 500\nHEIGHT 1\n"


@pytest.mark.parametrize(
    "data",
    [
        b"# .PCD v0.7 - Point Cloud Data\n# FIELDS a b c\n" + pcd(),
        b"\r\n".join(pcd().split(b"\n")[:10]) + b"\r\n" + b"\n".join(pcd().split(b"\n")[10:]),
        changed(pcd(), b"VERSION 0.7\n", b""),
        changed(pcd(), b"FIELDS", b"COLUMNS"),
        changed(pcd(), b"COUNT 1 1 1 1\n", b""),
        changed(pcd(), b"VIEWPOINT 0 0 0 1 0 0 0", b"VIEWPOINT 5 6 7 0 1 0 0"),
        changed(pcd(), HEAD, b"WIDTH 25\nHEIGHT 20\n"),
        changed(pcd(), b"POINTS 500\n", b""),
        changed(pcd(), HEAD, b""),
        changed(pcd(), b"x y z intensity", b"X Y Z scalar_Intensity"),
        pcd() + b"\n",
        pcd("ascii").replace(b"\n", b"\r\n"),
        pcd("ascii") + b"\n \n",
        # PCL leaves padding out of its text and of its compressed data
        pcd_of(padded(), "ascii").split(b"DATA")[0] + b"DATA" + pcd("ascii").split(b"DATA")[1],
        pcd_of(padded(), ENCODINGS[2]).split(b"DATA")[0] + b"DATA"
        + pcd(ENCODINGS[2]).split(b"DATA")[1],
        ply("ascii").replace(b"\n", b"\r\n"),
        ply().replace(b"comment by hand", b"obj_info end_header here\r"),
        ply().replace(b"float", b"float32"),
        ply(names=("X", "y", "z", "scalar_Intensity")),
        ply(after=NO_FACES),
    ],
)  # fmt: skip
def test_headers_of_other_writers_are_read(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / ("cloud.ply" if data.startswith(b"ply") else "cloud.pcd")
    path.write_bytes(data)
    np.testing.assert_array_equal(load_cloud(path), CLOUD)


PACKED = pcd_of(fields_of(CLOUD), "binary_compressed", points=2**27).split(b"compressed\n")[0]
BROKEN = {
    "malformed PCD header": changed(pcd(), b"FIELDS x y z intensity", b"FIELDS x y z"),
    "malformed PCD header .'TYPE'": changed(pcd(), b"TYPE F F F F\n", b""),
    "malformed PCD header: its FIELDS": changed(pcd(), b"TYPE F F F F", b"TYPE F F F Q"),
    "do not fit": changed(pcd(), b"SIZE 4 4 4 4", b"SIZE 1 4 4 4"),
    "HEIGHT and POINTS do not fit": changed(pcd(), b"WIDTH 500", b"WIDTH 7"),
    "and COUNT, or its WIDTH": changed(pcd(), b"COUNT 1 1 1 1", b"COUNT 1 1 1 0"),
    "found '-1', expected a number": changed(pcd(), b"COUNT 1 1 1 1", b"COUNT 1 1 1 -1"),
    "expected a number": changed(pcd(), b"WIDTH 500", b"WIDTH 5_00"),
    "is truncated": changed(pcd(), b"COUNT 1 1 1 1", b"COUNT 1 1 1 99999999999"),
    "expected one x": changed(pcd(), b"COUNT 1 1 1 1", b"COUNT 2 1 1 1"),
    "fields x a z intensity, expected one y": changed(pcd(), b"x y z", b"x a z"),
    "unknown encoding": changed(pcd(), b"DATA binary", b"DATA binary_lz4"),
    "no complete .pcd header": changed(pcd(), b"DATA", b"DATE"),
    "compressed data are not its 134217728 points": PACKED + b"compressed\n"
    + struct.pack("<II", 1000, 2**31) + lzf_of_literals(bytes(2000)),
    "ply: goes on after the 499 points": ply().replace(b"vertex 500", b"vertex 499"),
    "text: goes on after": ply("ascii").replace(b"vertex 500", b"vertex 499"),
    "ply: is truncated": ply().replace(b"vertex 500", b"vertex 501"),
    "is truncated: 500 of its 501": ply("ascii").replace(b"vertex 500", b"vertex 501"),
    "many: is truncated": ply().replace(b"vertex 500", b"vertex " + b"9" * 18),
    "holds no point": ply().replace(b"vertex 500", b"vertex 0"),
    "malformed PLY header, at": ply().replace(b"vertex 500", b"vertex -5"),
    "at .element vertex 999": ply().replace(b"vertex 500", b"vertex " + b"9" * 5000),
    "no plain list of vertices": ply().replace(b"vertex", b"vertices"),
    "list: malformed PLY header": ply(after=b"property list uchar int a\n"),
    "holds 'face' besides its vertices": ply(after=FACES),
    "malformed PLY header, at 'property quad x'": ply().replace(b"float x", b"quad x"),
    "no complete .ply header": ply().replace(b"ply\n", b"plx\n", 1),
    "middle: unknown encoding": ply().replace(b"_little", b"_middle"),
    "fields a y z intensity, expected one x": ply(names=("a", "y", "z", "intensity")),
    "two: expected one x": ply(names=("x", "x", "y", "z")),
    "first point has 3 numbers": ply("ascii").replace(b"end_header\n", b"end_header\n1 2 3\n"),
    "no points where they should be": ply("ascii")[:-20] + b" word\n",
}  # fmt: skip


def test_lzf_is_unpacked_with_repeats_that_overlap_and_refused_if_damaged() -> None:
    packed = np.frombuffer(b"\x02abc\x20\x02\xe0\x05\x00\x00z", np.uint8)
    unpacked = unpack_lzf(packed, 3 + 3 + 14 + 1)
    assert unpacked is not None and unpacked.tobytes() == b"abcabc" + b"c" * 14 + b"z"
    for bad in (b"\x05abc", b"\x20\x00", b"\x00a\x20\x05", b"\x00a\xe0", b"\x00a\x20", b""):
        assert unpack_lzf(np.frombuffer(bad, np.uint8), 4) is None


def test_the_compressed_clouds_of_open3d_are_read(tmp_path: Path, open3d: Any) -> None:
    points = np.round(CLOUD, 1)  # repeats
    cloud = open3d.t.geometry.PointCloud(open3d.core.Tensor(points[:, :3].copy()))
    cloud.point["intensity"] = open3d.core.Tensor(points[:, 3:].copy())
    open3d.t.io.write_point_cloud(str(tmp_path / "cloud.pcd"), cloud, compressed=True)
    np.testing.assert_array_equal(load_cloud(tmp_path / "cloud.pcd"), points)


def written(path: Path, cloud: NDArray[Any]) -> Path:
    """A cloud in the format of the suffix."""
    columns = dict(zip(("x", "y", "z", "Intensity"), cloud.T, strict=False))
    if path.suffix == ".npy":
        np.save(path, cloud)
    elif path.suffix == ".bin":
        cloud.astype("<f4").tofile(path)
    elif path.suffix == ".feather":
        feather.write_feather(pa.table(columns), path)
    else:
        path.write_bytes(pcd_of(fields_of(cloud.astype(np.float32))))
    return path


@pytest.mark.parametrize("nothing", [np.nan, 0.0])
@pytest.mark.parametrize("suffix", [".npy", ".bin", ".feather", ".pcd"])
def test_points_without_a_return_are_left_out(suffix: str, nothing: float, tmp_path: Path) -> None:
    path, organised = tmp_path / f"cloud{suffix}", CLOUD.astype(np.float64)
    np.testing.assert_array_equal(load_cloud(written(path, CLOUD)), CLOUD)
    organised[np.random.default_rng(0).choice(500, 100, replace=False), :3] = nothing
    assert len(load_cloud(written(path, organised))) == 400


def test_a_feather_file_that_states_more_than_it_can_hold_is_refused(tmp_path: Path) -> None:
    zeros = np.zeros(10_000_000, np.float32)
    for packing in ("zstd", "lz4"):
        path = tmp_path / f"{packing}.feather"
        feather.write_feather(pa.table(dict.fromkeys("xyz", zeros)), path, compression=packing)
        with pytest.raises(FileError, match="states 120 MB in .* points do not pack so"):
            load_cloud(path)


def with_intensity(kind: str) -> NDArray[np.float32]:
    cloud = np.tile(CLOUD, (20, 1))
    if kind == "packed":  # colours
        bits = np.random.default_rng(0).integers(0, 2**32, len(cloud), dtype=np.uint32)
        cloud[:, 3] = bits.view(np.float32)
    elif kind == "half":
        cloud[::2, 3] = np.nan
    elif kind == "infinite":  # at one point
        cloud[0, 3] = np.inf
    elif kind == "constant":
        cloud[:, 3] = 7
    elif kind == "no return":
        cloud[::2] = np.nan
    return cloud


@pytest.mark.parametrize(
    ("kind", "note"),
    [("packed", "it is none, and is left out"), ("half", "it is none, and is left out"),
     ("infinite", ""), ("no return", ""), ("constant", "the intensity is 7 at all points")],
)  # fmt: skip
def test_an_intensity_of_another_field_is_left_out_with_a_note(
    kind: str, note: str, tmp_path: Path
) -> None:
    path = written(tmp_path / "cloud.npy", with_intensity(kind))
    assert np.isnan(load_cloud(path)[:, 3]).all() == ("left out" in note)
    notes = Frame(0, "0", path, {}).describe_cloud()
    assert len(notes) == bool(note) and all(note in each for each in notes)


def test_a_cloud_without_intensity_is_noted_with_its_fields(tmp_path: Path) -> None:
    (tmp_path / "cloud.pcd").write_bytes(changed(pcd(), b"z intensity", b"z height"))
    (note,) = Frame(0, "0", tmp_path / "cloud.pcd", {}).describe_cloud()
    assert "no intensity among its fields x y z height; the error bars become about twice" in note
    assert Frame(0, "0", tmp_path / "missing.pcd", {}).describe_cloud() == []
    assert load_dataset(SAMPLE).notes == ()


def test_only_clouds_of_more_points_than_are_used_are_thinned(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """At random, the same each time, in order; the rest is bit-equal."""
    monkeypatch.setattr(clouds, "MOST_POINTS", 100)
    cloud = np.arange(4 * 300, dtype=np.float32).reshape(300, 4) + 1
    assert clouds.thin_cloud(cloud[:100]).base is cloud
    frame = Frame(0, "0", written(tmp_path / "0.npy", cloud), {})
    thinned = frame.load_cloud()
    np.testing.assert_array_equal(thinned, frame.load_cloud())
    rows = ((thinned[:, 0] - 1) / 4).astype(int)
    np.testing.assert_array_equal(thinned, cloud[rows])
    assert len(set(rows)) == 100 and (np.diff(rows) > 0).all() and 120 < rows.mean() < 180
    (line,) = clouds.describe_thinned([99, 100])
    assert line.startswith("1 of 2 clouds have 100 points or more")
    assert not clouds.describe_thinned([99])


ROWS = np.load(SAMPLE / "lidar" / "000000.npy")
ROWS = ROWS[: len(ROWS) // 60 * 60]  # whole rows of every number of columns
RNG = np.random.default_rng(0)
RING = np.digitize(np.arctan2(ROWS[:, 2], np.hypot(ROWS[:, 0], ROWS[:, 1])), np.linspace(-1, 1, 99))
TIMES = np.linspace(0, 0.1, len(ROWS))
SIX = np.column_stack([ROWS, RING, TIMES]).astype("<f4")


@pytest.mark.parametrize("columns", [3, 4, 5, 6])
@pytest.mark.parametrize("order", [slice(None), RNG.permutation(len(ROWS)), slice(0, None, 5)])
def test_columns_are_told_by_content(order: slice, columns: int, tmp_path: Path) -> None:
    rows = SIX[order, :columns]
    rows.tofile(tmp_path / "cloud.bin")
    expected = np.full((len(rows), 4), np.nan, np.float32)
    expected[:, : min(4, columns)] = rows[:, :4]
    np.testing.assert_array_equal(load_cloud(tmp_path / "cloud.bin"), expected)
    told = read_returns(tmp_path / "cloud.bin").told
    assert told == "" if columns == 4 else f"{columns} columns by its content" in told


def test_the_columns_of_the_rig_count_and_stay_in_the_result(tmp_path: Path) -> None:
    """By its content this is x y z intensity ring; the rig has another order."""
    rows = SIX[:, [4, 2, 1, 0, 3]]
    for folder in ("lidar", "cameras/front"):
        (tmp_path / folder).mkdir(parents=True)
    rows.tofile(tmp_path / "lidar" / "0.bin")
    (tmp_path / "cameras" / "front" / "0.png").touch()
    columns = ("ring", "z", "y", "x", "intensity")
    Rig(cameras={"front": make_camera()}, cloud_columns=columns).save(tmp_path / "rig.yaml")
    assert yaml.safe_load((tmp_path / "rig.yaml").read_text())["cloud_columns"] == [*columns]
    (frame,) = load_dataset(tmp_path).frames
    for cloud in (frame.load_cloud(), frame_of_entry(frame.entry()).load_cloud()):
        np.testing.assert_array_equal(cloud, ROWS)
    assert frame_of_entry(frame.entry()).columns == [*columns]
    Rig(cameras={"front": make_camera()}).save(tmp_path / "rig.yaml")
    assert "cloud_columns" not in (tmp_path / "rig.yaml").read_text()


def npy(array: NDArray[Any]) -> bytes:
    data = io.BytesIO()
    np.save(data, array, allow_pickle=True)
    return data.getvalue()


def with_value(row: int, column: int, value: float) -> NDArray[np.float32]:
    cloud = CLOUD.copy()
    cloud[row, column] = value
    return cloud


def npy_header(text: str) -> bytes:
    return (
        b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text) + 1) + text.encode() + b"\n" + bytes(64)
    )


SHAPE = "{'descr': '<f4', 'fortran_order': False, 'shape': %s, }"
NO_ARRAY = "cannot be read as a .npy array"
np.savez(ARCHIVE := io.BytesIO(), CLOUD)
REFUSED = [
    *((f"cloud.{'ply' if b'format ' in data[:30] else 'pcd'}", data, said)
      for said, data in BROKEN.items()),
    *(("cloud.pcd", pcd_of(fields_of(CLOUD), encoding, points=points),
       r"cloud.pcd: (goes on|is truncated|its compressed)")
      for encoding in ENCODINGS for points in (1, 499, 501, 10**9, 10**17)),
    *(("cloud.pcd", pcd_of(fields_of(CLOUD), encoding)[:kept], r"cloud.pcd")
      for encoding in ENCODINGS for kept in (1, 100, 300, 1000, -100)),
    ("infinite.npy", npy(with_value(7, 1, np.inf)), "point 7 is not finite"),
    ("far.npy", npy(with_value(3, 1, -1e9)), r"holds a coordinate of 1e\+09, expected metres"),
    *((name, npy(array), name) for name, array in {
        "flat.npy": CLOUD.ravel(), "text.npy": np.array(["a", "b"]),
        "nothing.npy": np.full((3, 4), np.nan), "transposed.npy": np.tile(CLOUD, (20, 1)).T,
        "origin.npy": np.zeros((100, 4)), "objects.npy": np.array([{}, None], dtype=object),
    }.items()),
    ("truncated.npy", npy(CLOUD)[:-100], "truncated.npy"),
    ("empty.npy", b"", "empty.npy"),
    ("archive.npy", b"PK\x03\x04" + bytes(64), NO_ARRAY),
    ("arrays.npy", ARCHIVE.getvalue(), "is an archive of arrays, expected one array"),
    *(("hostile.npy", npy_header(text), NO_ARRAY) for text in (
        SHAPE % "(100000000000, 4)", SHAPE % "(-5, 4)", SHAPE % f"(1{'0' * 400}, 4)",
        SHAPE % f"{'-' * 9000}1", SHAPE % f"{'[' * 4000}{']' * 4000}", "{" * 9000)),
    *(("less.npy", npy(CLOUD).replace(b"(500, 4)", shape), r"goes on after the \(\d+, \d\) numbers")
      for shape in (b"(500, 3)", b"(499, 4)", b"(250, 4)")),
    ("empty.bin", b"", "empty.bin"),
    ("tiny.bin", b"12345", "tiny.bin"),
    ("random.bin", np.random.default_rng(0).bytes(16 * 50_000), "cannot be told by its content"),
    ("odd.bin", ROWS[:5001].tobytes()[:-8], "whole number of points of 4 float32; is it complete"),
    ("other.pcd.bin", ROWS.tobytes(), "4 columns by its content, expected nuScenes' 5"),
    ("turned.bin", np.ascontiguousarray(ROWS.T).tobytes(), "all x first, then all y"),
    ("wide.bin", ROWS.astype("<f8").tobytes(), "write `cloud_columns: .x, y, z, intensity"),
    ("round.bin", np.round(ROWS.astype("<f8") * 8).tobytes(), "cannot be told by its content"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "said"), REFUSED, ids=range(len(REFUSED)))
def test_what_is_no_cloud_is_named_in_one_line(
    name: str, content: bytes, said: str, tmp_path: Path
) -> None:
    """A header may claim less than there is, or more than any memory."""
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FileError, match=re.sub(r"^[\w ]+: (?=\w)", "", said)) as caught:
        load_cloud(tmp_path / name)
    assert "\n" not in str(caught.value) and name in str(caught.value)


def test_named_columns_without_an_axis_are_refused(tmp_path: Path) -> None:
    ROWS.tofile(tmp_path / "cloud.bin")
    with pytest.raises(FileError, match="has the fields x y ring a, expected one z"):
        load_cloud(tmp_path / "cloud.bin", columns=("x", "y", "ring", "a"))
