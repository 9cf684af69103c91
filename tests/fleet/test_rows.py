from __future__ import annotations

import itertools
import threading
from pathlib import Path

import pyarrow as pa
import pytest
from pyarrow import parquet

from calibgraph import CalibrationError, FileError
from calibgraph.fleet.rows import SCHEMA, RowStore, bucket_of, read_rows


def rows(*vehicles: str, camera: str = "front", **others: object) -> pa.Table:
    made = [
        {"vehicle": name, "camera": camera, "recording": "drive", "status": "done"}
        for name in vehicles
    ]
    table = pa.Table.from_pylist(made, schema=SCHEMA)
    for name, value in others.items():
        table = table.append_column(name, pa.array([value] * len(vehicles)))
    return table


def test_rows_of_one_job_replace_each_other(tmp_path: Path) -> None:
    store = RowStore(str(tmp_path / "out"))
    store.publish(rows("a", "b", camera=""))
    store.publish(rows("a", camera="front"))
    store.publish(rows("a", camera="left"))
    found = read_rows(str(tmp_path / "out")).select(["vehicle", "camera"]).to_pylist()
    assert sorted(tuple(row.values()) for row in found) == [("a", "left"), ("b", "")]


def test_columns_that_only_some_rows_have_are_null_in_the_others(tmp_path: Path) -> None:
    store = RowStore(str(tmp_path))
    store.publish(rows("a"))
    store.publish(rows("a-2", batch="2026-03"))
    found = read_rows(str(tmp_path))
    by_vehicle = dict(zip(found["vehicle"].to_pylist(), found["batch"].to_pylist(), strict=True))
    assert by_vehicle == {"a": None, "a-2": "2026-03"}


def test_files_of_others_are_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / f"bucket={bucket_of('a'):02x}" / "rows.parquet"
    path.parent.mkdir()
    parquet.write_table(pa.table({"x": [1]}), path)
    before = path.read_bytes()
    with pytest.raises(FileError, match="is not of a fleet of format calibgraph-fleet/1"):
        RowStore(str(tmp_path)).publish(rows("a"))
    assert path.read_bytes() == before


def test_rows_are_kept_on_a_store_that_is_not_local() -> None:
    store = RowStore("memory://fleet-rows")
    store.publish(rows("a", "b"))
    store.publish(rows("b"))
    assert sorted(read_rows("memory://fleet-rows")["vehicle"].to_pylist()) == ["a", "b"]


def test_an_empty_place_is_refused() -> None:
    with pytest.raises(CalibrationError, match="--out is empty"):
        RowStore("")


def test_a_folder_without_rows_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="give what calibgraph fleet wrote"):
        read_rows(str(tmp_path))
    with pytest.raises(FileError, match="give what calibgraph fleet wrote"):
        read_rows(str(tmp_path / "none"))


def test_a_reader_finds_whole_rows_while_they_are_replaced(tmp_path: Path) -> None:
    store, stop = RowStore(str(tmp_path)), threading.Event()
    store.publish(rows("a"))

    def replace() -> None:
        for length in itertools.cycle((1, 2000)):
            if stop.is_set():
                return
            store.publish(rows("a", note="x" * length))

    writer = threading.Thread(target=replace)
    writer.start()
    try:
        lengths = [len(read_rows(str(tmp_path))) for _ in range(200)]
    finally:
        stop.set()
        writer.join()
    assert lengths == [1] * 200
