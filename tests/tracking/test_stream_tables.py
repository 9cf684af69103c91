"""Frames of Parquet and CSV files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from calibgraph.tracking.streams import StreamFrame, frames_of
from tests.tracking.stream_data import (
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
