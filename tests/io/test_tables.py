"""Tables from disk: what was written is read, what is wrong is named in one line."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from calibgraph import (
    CorrespondenceError,
    Correspondences,
    FileError,
    load_correspondences,
    simulate_correspondences,
)
from calibgraph.io.tables import from_arrow, load_camera_matches
from calibgraph.model.camera_matches import CameraMatches
from tests.conftest import make_pair
from tests.model.tables import camera_matches, table, to_arrow


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_a_file_returns_the_same_table(suffix: str, tmp_path: Path) -> None:
    given = table(
        information_px=[[1, 0, 1], [2, 0.5, 1], [1, 1, 1], [4, 0, 0]],
        stamp_ns=[1, 2, 2, 1_700_000_000_123_456_789],
        metadata={"matcher": "by hand", "settings": {"k": 1}},
    )
    path = tmp_path / f"table{suffix}"
    given.save(path)
    read = load_correspondences(path)
    assert [read.cameras[i] for i in read.camera_index] == ["left", "left", "right", "left"]
    for name in ("frame", "pixels_px", "points_lidar_m", "confidence", "stamp_ns"):
        np.testing.assert_array_equal(getattr(read, name), getattr(given, name))
    np.testing.assert_array_equal(read.information_px, given.information_px)
    if suffix == ".parquet":
        assert read.metadata == given.metadata
        assert parquet.read_schema(path).metadata[b"format"] == b"calibgraph-correspondences/1"


def test_a_table_written_by_another_tool_is_read(tmp_path: Path) -> None:
    """Plain strings, float32, no confidence or metadata, other order, a column of older tables."""
    columns = {
        "x_m": np.float32([1.5, 2]), "y_m": np.float32([0, 1]), "z_m": np.float32([0, 1]),
        "u_px": np.float32([5, 6]), "v_px": np.float32([7, 8]),
        "frame": [3, 4], "camera": ["a", "b"], "point_index": [7, -1],
    }  # fmt: skip
    path = tmp_path / "table.parquet"
    parquet.write_table(pa.table(columns), path)
    read = load_correspondences(path)
    assert read.points_lidar_m[0].tolist() == [1.5, 0, 0]
    assert read.confidence.tolist() == [1, 1]
    assert read.counts() == {"a": 1, "b": 1}


HEAD = b"camera,frame,u_px,v_px,x_m,y_m,z_m\n"
GOOD = to_arrow(table())
CORRESPONDENCES: dict[str, pa.Table | bytes] = {
    "cannot be read as Parquet": b"hello",
    "cannot be read as Parquet, empty": b"",
    "unknown column 'weight'": GOOD.append_column("weight", pa.array([1.0] * 4)),
    "column 'u_px' is missing": GOOD.drop_columns(["u_px"]),
    "has the format 'calibgraph-correspondences/9'": GOOD.replace_schema_metadata(
        {"format": "calibgraph-correspondences/9"}
    ),
    "metadata, no JSON": GOOD.replace_schema_metadata({"matcher": "not JSON"}),
    "metadata must be a mapping": GOOD.replace_schema_metadata({"matcher": "[1]"}),
    "metadata, deep": GOOD.replace_schema_metadata({"matcher": "[" * 100_000}),
}
CSV: dict[str, bytes] = {
    "table.csv, empty": b"",
    "table.csv, ragged": b"camera,frame\nleft\n",
    "table.csv, columns missing": b"camera,frame\nleft,3\n",
    "table.csv, a word": HEAD + b"left,zero,1,2,3,4,5\n",
    "table.csv, a cell missing": HEAD + b"left,0,1.5,2,3,4,\n",
    "table.csv, no row": HEAD,
    "table.csv, a column twice": b"camera," + HEAD + b"a,a,0,1,2,3,4,5\n",
    "table.csv, half a frame": HEAD + b"left,0.5,1,2,3,4,5\n",
    "table.csv: a column's name is not UTF-8": HEAD.replace(b"frame", b"fr\xffame")
    + b"left,1,1,2,3,4,5\n",
    "separated by semicolons": b"camera;frame\na;0\n",
    "separated by tabs": b"camera\tframe\na\t0\n",
}
MATCHES = camera_matches().to_arrow()
CAMERA_MATCHES: dict[str, pa.Table] = {
    "is missing": MATCHES.drop_columns(["u_a_px"]),
    "unknown column 'more'": MATCHES.append_column("more", pa.array([1, 2, 3])),
    "format": MATCHES.replace_schema_metadata({"format": "calibgraph-correspondences/1"}),
    "is empty": MATCHES.set_column(0, "camera_a", pa.array(["left", None, "right"])),
    "'u_a_px' must hold numbers, found string": MATCHES.set_column(
        3, "u_a_px", pa.array(["x", "y", "z"])
    ),
    "row 0: planes": MATCHES.set_column(
        MATCHES.column_names.index("qx_a_per_m"), "qx_a_per_m", pa.array([None, 1.0, None])
    ),
}
BAD = [
    *((load_correspondences, "table.parquet", *row) for row in CORRESPONDENCES.items()),
    *((load_correspondences, "table.csv", *row) for row in CSV.items()),
    *((load_camera_matches, "table.parquet", *row) for row in CAMERA_MATCHES.items()),
    (load_camera_matches, "table.csv", "a column's name is not UTF-8", b"fr\xff\n"),
]


@pytest.mark.parametrize(("load", "name", "said", "content"), BAD, ids=[row[2] for row in BAD])
def test_a_bad_file_is_named_in_one_line(
    load: Callable[[Path], object], name: str, said: str, content: pa.Table | bytes, tmp_path: Path
) -> None:
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        parquet.write_table(content, path)
    with pytest.raises(FileError, match=said.partition(", ")[0]) as caught:
        load(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


@pytest.mark.parametrize("load", [load_correspondences, load_camera_matches])
def test_a_file_that_is_not_there_or_not_whole_is_named(
    load: Callable[[Path], object], tmp_path: Path
) -> None:
    path, given = tmp_path / "table.parquet", GOOD if load is load_correspondences else MATCHES
    parquet.write_table(given, path)
    for kept in (-200, -50, 100):
        path.write_bytes(path.read_bytes()[:kept])
        with pytest.raises(FileError, match="table.parquet: cannot be read as Parquet"):
            load(path)
    with pytest.raises(FileError, match="no such file"):
        load(tmp_path / "missing.parquet")
    with pytest.raises(FileError, match="cannot be read .*name too long.*; check the path"):
        load(tmp_path / ("x" * 300 + ".parquet"))


def changed(name: str, column: pa.Array | pa.ChunkedArray, **metadata: str | bytes) -> pa.Table:
    """A good Arrow table with one column, or its metadata, replaced."""
    arrow = GOOD.set_column(GOOD.column_names.index(name), name, column)
    return arrow.replace_schema_metadata(metadata)


FOUR = [1.0] * 4


CAMERAS = pa.array([0, 1, 0, 2])


@pytest.mark.parametrize(
    ("arrow", "message"),
    [
        (GOOD.drop_columns(["v_px"]), "column 'v_px' is missing"),
        (changed("confidence", pa.array([1, 1e300, 1, 1])), r"row 1 .*lie in \(0, 1\]"),
        (changed("u_px", pa.array([1, None, 1, 1])), "row 1: column 'u_px' is empty"),
        (changed("u_px", pa.nulls(4)), "column 'u_px' is empty; fill in or drop it"),
        (changed("camera", pa.array(["a", "b", None, "c"])), "row 2: column 'camera' is empty"),
        (
            changed("camera", pa.DictionaryArray.from_arrays(CAMERAS, ["a", None, "b"])),
            "row 1: column 'camera' is empty",
        ),
        (changed("camera", pa.array([b"\xff"] * 4)), "has the wrong type: Invalid UTF8"),
        (changed("frame", pa.array([2**63] * 4, pa.uint64())), "'frame' .* beyond 64 bits"),
        (changed("frame", pa.array(FOUR)), "'frame' must hold whole numbers, found double"),
        (changed("u_px", pa.array(["1"] * 4)), "'u_px' must hold numbers, found string"),
        (
            changed("u_px", pa.RunEndEncodedArray.from_arrays([4], [1.0])),
            "'u_px' must hold numbers, found run_end_encoded",
        ),
        (
            changed("u_px", pa.array(FOUR), matcher='{"systematic_rotation_rad": -1}'),
            "systematic_rotation_rad: .* greater than or equal to 0, found -1",
        ),
        (
            changed("u_px", pa.array(FOUR), matcher=b'{"a": "\xff"}'),
            "the metadata has the wrong type",
        ),
    ],
)
def test_wrong_arrow_data_is_named_in_one_line(arrow: pa.Table, message: str) -> None:
    with pytest.raises(CorrespondenceError, match=message) as caught:
        from_arrow(arrow)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "cameras",
    [
        pa.array(["left", "left", "right", "left"]).dictionary_encode(),
        pa.array(["left", "left", "right", "left"], pa.large_string()),
        pa.array([b"left", b"left", b"right", b"left"]),
        pa.DictionaryArray.from_arrays([0, 1, 3, 0], ["left", "left", None, "right"]),
    ],
)
def test_names_of_cameras_may_be_any_text(cameras: pa.Array | pa.ChunkedArray) -> None:
    read = from_arrow(changed("camera", cameras))
    assert read.counts() == {"left": 3, "right": 1}


def test_a_long_name_does_not_take_its_memory_for_every_row(tmp_path: Path) -> None:
    path, rows = tmp_path / "table.parquet", 20_000
    name = pa.DictionaryArray.from_arrays(pa.array([0] * rows, pa.int32()), ["n" * 100_000])
    given = GOOD.take(pa.array([0] * rows))
    parquet.write_table(given.set_column(0, "camera", name), path)  # 2 GB if it is written out
    before = pa.total_allocated_bytes()
    with pytest.raises(FileError, match="a name of 100000 bytes"):
        load_correspondences(path)
    assert pa.total_allocated_bytes() - before < 10**8


def test_changed_bytes_of_a_table_are_not_taken_for_numbers(tmp_path: Path) -> None:
    path = tmp_path / "table.parquet"
    rng = np.random.default_rng(0)
    given = Correspondences.from_arrays(
        camera="left", frame=0, pixels_px=rng.uniform(0, 300, (2000, 2)),
        points_lidar_m=rng.normal(size=(2000, 3)),
    )  # fmt: skip
    given.save(path)
    data = bytearray(path.read_bytes())
    place = data.find(given.points_lidar_m[1000:1003, 0].tobytes())
    assert place > 0  # random numbers are not compressed
    data[place] ^= 1
    path.write_bytes(data)
    with pytest.raises(FileError, match="cannot be read as Parquet"):
        load_correspondences(path)


def test_csv_says_that_it_holds_no_metadata(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """When it is written, if there is any."""
    simulated = simulate_correspondences(make_pair(), frames=6, matches=40)
    given = (
        (simulated, "csv", 1),
        (replace(simulated, metadata={}), "csv", 0),
        (simulated, "parquet", 0),
    )
    for one, suffix, expected in given:
        caplog.clear()
        one.save(tmp_path / f"table.{suffix}")
        assert len(caplog.records) == expected


def test_rows_that_a_file_cannot_hold_are_refused_by_its_footer(tmp_path: Path) -> None:
    path, rows = tmp_path / "table.parquet", 2_000_000
    columns = {name: np.zeros(rows, np.float32) for name in ("u_px", "v_px", "x_m", "y_m", "z_m")}
    columns |= {"frame": np.zeros(rows, np.int64)}
    names = pa.DictionaryArray.from_arrays(np.zeros(rows, np.int8), ["a"])
    parquet.write_table(pa.table({"camera": names, **columns}), path)
    with pytest.raises(FileError, match=r"states 2000000 rows of .* MB: matches do not pack so"):
        load_correspondences(path)


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_a_file_returns_the_same_camera_matches(suffix: str, tmp_path: Path) -> None:
    given = camera_matches()
    path = tmp_path / f"pairs{suffix}"
    given.save(path)
    read = load_camera_matches(path)
    assert read.cameras == given.cameras
    for name in ("camera_index", "frame", "pixels_px", "planes_lidar_per_m"):
        np.testing.assert_array_equal(getattr(read, name), getattr(given, name))
    if suffix == ".parquet":
        assert read.metadata == given.metadata


def test_an_empty_table_keeps_its_cameras(tmp_path: Path) -> None:
    path = tmp_path / "none.parquet"
    CameraMatches.empty(("a", "b")).save(path)
    assert len(load_camera_matches(path)) == 0
    assert load_camera_matches(path).cameras == ("a", "b")
