"""Frames of Parquet and CSV files."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from calibgraph import concatenate
from calibgraph.tracking.streams import StreamFrame, frames_of
from tests.tracking.stream_data import (
    of_bytes,
    outcomes,
    spoilt,
    table,
    to_arrow,
)

# Tables


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_a_table_gives_its_frames_in_ascending_order(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"table{suffix}"
    stamps = {"stamp_ns": [30, 10, 20, 31]}
    table([3, 1, 2, 3], camera="left", metadata={"matcher": "m"}, **stamps).save(path)
    frames = list(frames_of(path))
    assert outcomes(frames) == [1, 2, 3]
    last = frames[-1]
    assert isinstance(last, StreamFrame)
    assert last.table.pixels_px[:, 0].tolist() == [0, 3]
    assert last.table.frame.tolist() == [3, 3]
    assert last.table.stamp_ns is not None and last.table.stamp_ns.tolist() == [30, 31]
    if suffix == ".parquet":
        assert last.table.metadata == {"matcher": "m"}


def test_all_cameras_of_a_frame_come_together(tmp_path: Path) -> None:
    path = tmp_path / "table.parquet"
    concatenate([table([0, 1], camera="left"), table([0, 1], camera="right")]).save(path)
    frames = [item for item in frames_of(path) if isinstance(item, StreamFrame)]
    assert [item.table.counts() for item in frames] == [{"left": 1, "right": 1}] * 2


@pytest.mark.parametrize("row_group_size", [1, 2, 3, 5, 100])
@pytest.mark.parametrize(
    "numbers", [[0, 0, 1, 2, 2, 2, 2, 2, 5], [1, 0, 2, 2, 3, 2, 4, 9, 5], [7] * 9, [3, 2, 1, 0]]
)
def test_row_groups_do_not_show(row_group_size: int, numbers: list[int], tmp_path: Path) -> None:
    path = tmp_path / "table.parquet"
    parquet.write_table(to_arrow(table(numbers)), path, row_group_size=row_group_size)
    frames = [item for item in frames_of(path) if isinstance(item, StreamFrame)]
    assert [item.frame for item in frames] == sorted(set(numbers))
    for item in frames:
        rows = np.flatnonzero(np.array(numbers) == item.frame)
        assert item.table.pixels_px[:, 0].tolist() == rows.tolist()


def test_a_sorted_table_is_read_by_row_groups(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "table.parquet"
    numbers = np.repeat(np.arange(50), 10).tolist()
    parquet.write_table(to_arrow(table(numbers)), path, row_group_size=25)
    read: list[int] = []
    whole = parquet.ParquetFile.read_row_group

    def counted(self: Any, group: int, columns: list[str] | None = None) -> Any:
        if columns is None:
            read.append(group)
        return whole(self, group, columns=columns)

    monkeypatch.setattr(parquet.ParquetFile, "read_row_group", counted)
    frames = frames_of(path)
    assert outcomes([next(frames), next(frames)]) == [0, 1]
    assert read == [0]
    assert outcomes(frames) == list(range(2, 50))
    assert read == list(range(20))


@pytest.mark.parametrize("row_group_size", [2, 100])
@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("u_px", np.nan, "pixel must be finite"),
        ("u_px", None, "column 'u_px' is empty"),
        ("camera", None, "column 'camera' is empty"),
        ("confidence", 1e300, "confidence must lie in"),
        ("confidence", 0.0, "confidence must lie in"),
    ],
)
def test_a_wrong_value_refuses_its_frame_alone(
    row_group_size: int, column: str, value: object, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "table.parquet"
    wrong = spoilt(to_arrow(table([0, 0, 1, 1, 2])), column, 2, value)
    parquet.write_table(wrong, path, row_group_size=row_group_size)
    first, refused, last = outcomes(frames_of(path))
    assert (first, last) == (0, 2)
    assert str(refused).startswith(f"{path}: frame 1 is left out; among its rows, row 0")
    assert message in str(refused)


def test_rows_without_a_frame_are_refused_together(tmp_path: Path) -> None:
    path = tmp_path / "table.parquet"
    wrong = spoilt(spoilt(to_arrow(table([0, 1, 2, 3])), "frame", 0, None), "frame", 2, None)
    parquet.write_table(wrong, path)
    refused, *frames = outcomes(frames_of(path))
    assert refused == f"{path}: column 'frame' is empty in 2 rows; fill in or drop them"
    assert frames == [1, 3]


def test_a_file_that_is_no_table_is_refused_in_one_line(tmp_path: Path) -> None:
    good = to_arrow(table([0]))
    wrong = {
        "is missing": good.drop_columns(["u_px"]),
        "unknown column 'weight'": good.append_column("weight", pa.array([1.0])),
        "holds no rows": good.slice(0, 0),
        "must hold whole numbers": spoilt(good, "frame", 0, 0.5),
        "must hold numbers": spoilt(good, "u_px", 0, "1"),
        "metadata systematic_rotation_rad": good.replace_schema_metadata(
            {"matcher": '{"systematic_rotation_rad": -1}'}
        ),
        "the metadata has the wrong type": good.replace_schema_metadata({"matcher": "no JSON"}),
    }
    path = tmp_path / "table.parquet"
    for message, arrow in wrong.items():
        parquet.write_table(arrow, path)
        (refused,) = outcomes(frames_of(path))
        assert message in str(refused)
        assert str(path) in str(refused)
    for name, data in {
        "cut.parquet": path.read_bytes()[:-9], "empty.parquet": b"", "empty.csv": b"",
        "names.csv": b"camera,fr\xffame\nleft,1\n",
    }.items():  # fmt: skip
        (tmp_path / name).write_bytes(data)
        (refused,) = outcomes(frames_of(tmp_path / name))
        assert "\n" not in str(refused)
        assert name in str(refused)


def test_a_damaged_row_group_ends_the_table_after_the_good_ones(tmp_path: Path) -> None:
    path = tmp_path / "table.parquet"
    numbers = np.repeat(np.arange(4), 1000).tolist()
    parquet.write_table(to_arrow(table(numbers)), path, row_group_size=1000, compression="gzip")
    group = parquet.ParquetFile(path).metadata.row_group(2)
    data = bytearray(path.read_bytes())
    start = group.column(2).data_page_offset
    data[start : start + group.column(2).total_compressed_size // 2] = b"\xff" * (
        group.column(2).total_compressed_size // 2
    )
    path.write_bytes(data)
    *frames, refused = outcomes(frames_of(path))
    assert frames == [0, 1]
    assert "cannot be read as Parquet" in str(refused)


# Standard input


def test_a_file_that_is_no_stream_is_named(tmp_path: Path) -> None:
    path = tmp_path / "table.parquet"
    table([0]).save(path)
    assert outcomes(of_bytes(path.read_bytes())) == [
        "standard input: is a Parquet file; send a line of JSON per frame"
    ]
    assert "is an Arrow stream" in str(outcomes(of_bytes(b"\xff\xff\xff\xff\0"))[0])
    assert "is an Arrow file" in str(outcomes(of_bytes(b"ARROW1\0\0\0"))[0])


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ([b"PA", b"R1xx\nyy"], "is a Parquet file; send a line of JSON per frame"),
        ([b"A", b"RRO", b"W1"], "is an Arrow file; send a line of JSON per frame"),
        ([b"PA", b"R"], "is not JSON"),
    ],
)
def test_a_mark_that_comes_in_parts_is_found(parts: list[bytes], message: str) -> None:
    class Parts(io.BytesIO):
        def read1(self, size: int | None = -1, /) -> bytes:
            return parts.pop(0) if parts else b""

    (found,) = outcomes(frames_of("-", stdin=Parts()))
    assert message in str(found)
