from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import ipc, parquet

from calibgraph import Correspondences, FileError, concatenate
from calibgraph.model.table_columns import to_arrow
from calibgraph.tracking import stream_lines, streams
from calibgraph.tracking.streams import Refused, StreamFrame, frames_of

to_arrow = Correspondences.to_arrow

COORDINATES = ("u_px", "v_px", "x_m", "y_m", "z_m")


def table(frames: list[int], *, camera: str = "left", **changes: Any) -> Correspondences:
    """One row per given frame number; its pixel's column says which row it is."""
    n = len(frames)
    columns: dict[str, Any] = {
        "camera": camera,
        "frame": np.array(frames, np.int64),
        "pixels_px": np.column_stack([np.arange(n), np.zeros(n)]),
        "points_lidar_m": np.tile([10.0, 0.0, 0.0], (n, 1)),
    }
    return Correspondences.from_arrays(**(columns | changes))


def spoilt(given: pa.Table, column: str, row: int, value: object) -> pa.Table:
    """An Arrow table with one value replaced."""
    index = given.column_names.index(column)
    values = given[column].to_pylist()
    values[row] = value
    return given.set_column(index, column, pa.array(values))


def arrow_stream(*tables: pa.Table) -> bytes:
    """An Arrow IPC stream with one record batch per table."""
    out = io.BytesIO()
    with ipc.new_stream(out, tables[0].schema) as writer:
        for one in tables:
            writer.write_table(one)
    return out.getvalue()


def camera(n: int = 1, **changes: Any) -> dict[str, Any]:
    return {key: [1.5] * n for key in COORDINATES} | changes


def line(frame: Any = 7, **changes: Any) -> bytes:
    """A line of JSON with one camera, or with other keys."""
    return json.dumps({"frame": frame, "cameras": {"left": camera()}} | changes).encode() + b"\n"


def of_bytes(data: bytes) -> list[StreamFrame | Refused]:
    return list(frames_of("-", stdin=io.BytesIO(data)))


def said(items: Any) -> list[int | str]:
    """Frame numbers, and the messages in between."""
    return [item.frame if isinstance(item, StreamFrame) else item.message for item in items]


def refusal(data: bytes) -> str:
    """The message of the first of two lines; the second, good one must come through."""
    message, frame = said(of_bytes(data.rstrip(b"\n") + b"\n" + line(8)))
    assert frame == 8
    assert isinstance(message, str)
    assert message.startswith("standard input, line 1: ")
    assert "\n" not in message
    return message


# Tables


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_a_table_gives_its_frames_in_ascending_order(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"table{suffix}"
    stamps = {"stamp_ns": [30, 10, 20, 31]}
    table([3, 1, 2, 3], camera="left", metadata={"matcher": "m"}, **stamps).save(path)
    frames = list(frames_of(path))
    assert said(frames) == [1, 2, 3]
    last = frames[-1]
    assert isinstance(last, StreamFrame)
    assert last.table.pixels_px[:, 0].tolist() == [0, 3]
    assert last.table.frame.tolist() == [3, 3]
    assert last.stamp_ns == 31
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
    assert said([next(frames), next(frames)]) == [0, 1]
    assert read == [0]
    assert said(frames) == list(range(2, 50))
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
    first, refused, last = said(frames_of(path))
    assert (first, last) == (0, 2)
    assert str(refused).startswith(f"{path}: frame 1 is left out; among its rows, row 0")
    assert message in str(refused)


def test_rows_without_a_frame_are_refused_together(tmp_path: Path) -> None:
    path = tmp_path / "table.parquet"
    wrong = spoilt(spoilt(to_arrow(table([0, 1, 2, 3])), "frame", 0, None), "frame", 2, None)
    parquet.write_table(wrong, path)
    refused, *frames = said(frames_of(path))
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
        "metadata 'systematic_rotation_rad'": good.replace_schema_metadata(
            {"matcher": '{"systematic_rotation_rad": -1}'}
        ),
        "the metadata has the wrong type": good.replace_schema_metadata({"matcher": "no JSON"}),
    }
    path = tmp_path / "table.parquet"
    for message, arrow in wrong.items():
        parquet.write_table(arrow, path)
        (refused,) = said(frames_of(path))
        assert message in str(refused)
        assert str(path) in str(refused)
    for name, data in {
        "cut.parquet": path.read_bytes()[:-9], "empty.parquet": b"", "empty.csv": b"",
        "names.csv": b"camera,fr\xffame\nleft,1\n",
    }.items():  # fmt: skip
        (tmp_path / name).write_bytes(data)
        (refused,) = said(frames_of(tmp_path / name))
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
    *frames, refused = said(frames_of(path))
    assert frames == [0, 1]
    assert "cannot be read as Parquet" in str(refused)


# Folders


def test_a_folder_gives_its_tables_in_the_order_of_their_names(tmp_path: Path) -> None:
    for name, numbers in {"b.csv": [1, 2], "a.parquet": [5], ".hidden.parquet": [9]}.items():
        table(numbers).save(tmp_path / name)
    (tmp_path / "notes.txt").write_text("no table")
    (tmp_path / "c.parquet").write_bytes(b"half")
    *frames, refused = said(frames_of(tmp_path))
    assert frames == [5, 1, 2]
    assert "c.parquet: cannot be read" in str(refused)


class Following:
    """A followed folder; its frames are pulled until there are so many, or time is up."""

    def __init__(self, folder: Path) -> None:
        self._until = float("inf")
        self._frames = frames_of(folder, follow=True, stop=self._stop)

    def _stop(self) -> bool:
        return time.monotonic() > self._until

    def next(self, *, seconds: float = 10) -> int | str | None:
        self._until = time.monotonic() + seconds
        item = next(self._frames, None)
        return None if item is None else said([item])[0]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorter waits than for real writers."""
    monkeypatch.setattr(streams, "POLL_S", 0.01)
    monkeypatch.setattr(streams, "QUIET_S", 0.4)


@pytest.mark.usefixtures("quick")
def test_a_followed_folder_gives_each_file_once_whenever_it_comes(tmp_path: Path) -> None:
    table([1]).save(tmp_path / "b.parquet")
    following = Following(tmp_path)
    assert following.next() == 1
    table([2]).save(tmp_path / "c.parquet")
    assert following.next() == 2
    table([0]).save(tmp_path / "a.parquet")
    assert following.next() == 0
    assert following.next(seconds=0.1) is None


@pytest.mark.usefixtures("quick")
def test_a_followed_file_is_read_when_it_is_complete(tmp_path: Path) -> None:
    table([1]).save(tmp_path / "whole.parquet")
    data = (tmp_path / "whole.parquet").read_bytes()
    folder = tmp_path / "folder"
    folder.mkdir()
    growing = folder / "a.parquet"

    def write() -> None:
        for part in range(4):
            with growing.open("ab") as file:
                file.write(data[len(data) * part // 4 : len(data) * (part + 1) // 4])
            time.sleep(0.05)

    writer = threading.Thread(target=write)
    writer.start()
    assert Following(folder).next() == 1
    writer.join()


@pytest.mark.usefixtures("quick")
def test_a_followed_csv_is_read_when_it_no_longer_grows(tmp_path: Path) -> None:
    """Half a CSV looks complete."""
    path = tmp_path / "a.csv"
    path.write_text("camera,frame,u_px,v_px,x_m,y_m,z_m\nleft,1,1,2,3,4,5\nleft,1,1,2,3,4,5")
    following = Following(tmp_path)
    assert following.next(seconds=0.05) is None
    with path.open("a") as file:
        file.write("5\n")
    item = next(frames_of(tmp_path, follow=True))
    assert isinstance(item, StreamFrame)
    assert item.table.points_lidar_m[:, 2].tolist() == [5, 55]


@pytest.mark.usefixtures("quick")
def test_a_followed_file_that_stays_unreadable_is_refused_once(tmp_path: Path) -> None:
    (tmp_path / "a.parquet").write_bytes(b"half")
    (tmp_path / "b.parquet").symlink_to(tmp_path / "nothing")
    (tmp_path / "c.parquet").mkdir()
    following = Following(tmp_path)
    start = time.monotonic()
    messages = sorted(str(following.next()).removeprefix(f"{tmp_path}/") for _ in range(3))
    assert time.monotonic() - start >= streams.QUIET_S - streams.POLL_S
    for message, expected in zip(
        messages, ["a.parquet: cannot", "b.parquet: no such", "c.parquet: is a folder"], strict=True
    ):
        assert message.startswith(expected)
    assert following.next(seconds=0.1) is None


@pytest.mark.usefixtures("quick")
def test_a_followed_folder_that_goes_away_ends_in_one_line(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    frames = frames_of(folder, follow=True)
    folder.rmdir()
    (refused,) = said(frames)
    assert "the folder cannot be read any more" in str(refused)


# Arrow


@pytest.mark.parametrize("strings", [False, True])
def test_an_arrow_stream_gives_whole_batches_frame_by_frame(strings: bool) -> None:
    both = concatenate([table([4, 2], camera="left"), table([4, 2], camera="right")])
    batches = [to_arrow(both), to_arrow(table([1], metadata={"matcher": "m"}))]
    if strings:
        batches = [b.set_column(0, "camera", b["camera"].cast("string")) for b in batches]
    batches[0] = batches[0].replace_schema_metadata(batches[1].schema.metadata)
    frames = [f for f in of_bytes(arrow_stream(*batches)) if isinstance(f, StreamFrame)]
    assert [f.frame for f in frames] == [4, 2, 1]
    assert [f.table.counts() for f in frames[:2]] == [{"left": 1, "right": 1}] * 2
    assert frames[2].table.metadata == {"matcher": "m"}


def test_a_wrong_value_in_an_arrow_stream_refuses_its_frame_alone() -> None:
    wrong = spoilt(to_arrow(table([0, 1, 2])), "u_px", 1, np.inf)
    first, refused, *others = said(of_bytes(arrow_stream(wrong, to_arrow(table([3])))))
    assert (first, others) == (0, [2, 3])
    assert str(refused).startswith("standard input, batch 1: frame 1 is left out")


def test_a_null_in_the_dictionary_of_cameras_refuses_its_frame_alone() -> None:
    cameras = pa.DictionaryArray.from_arrays([0, 1, 0], ["left", None])
    (first, refused, last) = said(
        of_bytes(arrow_stream(to_arrow(table([0, 1, 2])).set_column(0, "camera", cameras)))
    )
    assert (first, last) == (0, 2)
    assert "frame 1 is left out; among its rows, row 0: column 'camera' is empty" in str(refused)


def test_a_wrong_schema_ends_an_arrow_stream_in_one_line() -> None:
    good = to_arrow(table([0, 1]))
    ends = pa.RunEndEncodedArray.from_arrays([2], [1.0])
    for message, arrow in {
        "column 'u_px' is missing": good.drop_columns(["u_px"]),
        "unknown column 'weight'": good.append_column("weight", pa.array([1.0, 2.0])),
        "column 'frame' must hold whole numbers": spoilt(good, "frame", 0, 0.5),
        "column 'u_px' must hold numbers, found run_end_encoded": good.set_column(
            2, "u_px", pa.chunked_array([ends])
        ),
        "column 'frame' must hold whole numbers, found list": good.set_column(
            1, "frame", pa.array([[1], [2]])
        ),
        "column 'camera' must hold text, found bool": good.set_column(
            0, "camera", pa.array([True] * 2)
        ),
        "has a column twice": good.append_column("u_px", pa.array([1.0, 2.0])),
        "metadata": good.replace_schema_metadata({"matcher": "[" * 100_000}),
    }.items():
        (refused,) = said(of_bytes(arrow_stream(arrow, arrow)))
        assert str(refused).startswith("standard input: ")
        assert message in str(refused)


def test_a_broken_arrow_stream_gives_what_came_and_one_refusal() -> None:
    """Cut at every byte: all whole batches before the cut, then nothing or one line."""
    data = arrow_stream(to_arrow(table([0])), to_arrow(table([1])))
    seen = set()
    for cut in range(4, len(data)):
        *frames, last = [*said(of_bytes(data[:cut])), None]
        refusals = [item for item in frames if isinstance(item, str)]
        assert last is None
        assert len(refusals) <= 1
        assert [item for item in frames if item not in refusals] in ([], [0], [0, 1])
        seen.add(tuple(item for item in frames if item not in refusals))
    assert seen == {(), (0,), (0, 1)}


def test_flipped_bytes_in_an_arrow_stream_raise_nothing() -> None:
    rng = np.random.default_rng(0)
    data = np.frombuffer(arrow_stream(to_arrow(table([0])), to_arrow(table([1]))), np.uint8)
    for _ in range(400):
        flipped = data.copy()
        flipped[rng.integers(4, len(data), rng.integers(1, 4))] = rng.integers(256)
        for item in of_bytes(flipped.tobytes()):
            assert isinstance(item, StreamFrame) or "\n" not in item.message


def test_a_damaged_length_in_an_arrow_stream_takes_no_memory() -> None:
    endless = b"\xff\xff\xff\xff" + (2**30).to_bytes(4, "little") + bytes(1000)
    (refused,) = said(of_bytes(endless))
    assert "a message of 1073741824 bytes, expected at most" in str(refused)


def test_a_file_that_is_no_stream_is_named(tmp_path: Path) -> None:
    path = tmp_path / "table.parquet"
    table([0]).save(path)
    assert said(of_bytes(path.read_bytes())) == [
        "standard input: is a Parquet file; send an Arrow stream or JSON lines"
    ]
    assert "is an Arrow file" in str(said(of_bytes(b"ARROW1\0\0"))[0])


# JSON lines


def test_a_json_line_is_a_frame() -> None:
    left = camera(2, confidence=[0.5, 1], point_index=[3, -1], u_px=[1, 2])
    right = camera(1, i_uu_px=[2], i_uv_px=[0.5], i_vv_px=[1])
    (item,) = of_bytes(
        line(cameras={"right": right, "left": left}, stamp_ns=2**62, metadata={"matcher": "m"})
    )
    assert isinstance(item, StreamFrame)
    assert (item.frame, item.stamp_ns, item.table.metadata) == (7, 2**62, {"matcher": "m"})
    assert item.table.counts() == {"left": 2, "right": 1}
    left_rows, right_rows = item.table.of_camera("left"), item.table.of_camera("right")
    assert left_rows.pixels_px.tolist() == [[1, 1.5], [2, 1.5]]
    assert left_rows.confidence.tolist() == [0.5, 1]
    assert left_rows.point_index is not None
    assert left_rows.point_index.tolist() == [3, -1]
    assert left_rows.information_px is not None
    assert left_rows.information_px.tolist() == [[1, 0, 1]] * 2
    assert right_rows.information_px is not None
    assert right_rows.information_px.tolist() == [[2, 0.5, 1]]
    assert right_rows.point_index is not None
    assert right_rows.point_index.tolist() == [-1]
    assert right_rows.confidence.tolist() == [1]


@pytest.mark.parametrize("cameras", [{}, {"left": camera(0)}])
def test_a_frame_without_rows_is_a_frame(cameras: dict[str, Any]) -> None:
    (item,) = of_bytes(line(9, cameras=cameras, stamp_ns=5, metadata={"k": 1}))
    assert isinstance(item, StreamFrame)
    assert (item.frame, item.stamp_ns, len(item.table)) == (9, 5, 0)
    assert item.table.cameras == tuple(cameras)
    assert item.table.metadata == {"k": 1}


def test_empty_lines_are_skipped_but_counted() -> None:
    assert said(of_bytes(b"\n \r\n" + line(1) + b"{\n" + line(2).rstrip())) == [
        1,
        "standard input, line 4: is not JSON (Expecting property name enclosed in double quotes "
        "at column 2); send one frame a line, as JSON",
        2,
    ]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (line()[:-9], "is not JSON"),
        (b"\xfe\xfe", "is not UTF-8"),
        (line()[:-1].decode().encode("utf-16"), "is not UTF-8"),
        (b"[" * 100_000, "is nested too deeply"),
        (b"[1]", "Input should be a JSON object, found [1]"),
        (b'{"frame": 1, "frame": 2, "cameras": {}}', "key 'frame' is given twice"),
        (b'{"frame": ' + b"9" * 5000 + b', "cameras": {}}', "cannot be read"),
        (b'{"frame": 7}', "key 'cameras' is missing"),
        (line(weather="rain"), "unknown key 'weather'; remove it"),
        (line(1.0), "frame: Input should be a valid integer, found 1.0"),
        (line(True), "frame: Input should be a valid integer, found True"),
        (line(2**63), "frame: Input should be less than 9223372036854775808, found"),
        (line("7"), "frame: Input should be a valid integer, found '7'"),
        (line(stamp_ns=None), "stamp_ns: Input should be a valid integer, found None"),
        (line(cameras=[]), "cameras: Input should be a JSON object, found []"),
        (line(cameras={"left": None}), "cameras.left: Input should be a JSON object, found None"),
        (line(cameras={"left": {}}), "key 'cameras.left.u_px' is missing"),
        (line(cameras={"left": camera(depth=[1])}), "unknown key 'cameras.left.depth'"),
        (line(cameras={"left": camera(u_px=5)}), "u_px: Input should be a valid list, found 5"),
        (
            line(cameras={"left": camera(u_px=[True])}),
            "u_px.0: Input should be a valid number, found True",
        ),
        (
            line(cameras={"left": camera(u_px=[[1]])}),
            "u_px.0: Input should be a valid number, found [1]",
        ),
        (
            line(cameras={"left": camera(u_px=[None])}),
            "u_px.0: Input should be a valid number, found None",
        ),
        (
            line(cameras={"left": camera(u_px=[10**400])}),
            "u_px.0: Input should be a valid number, found 1000",
        ),
        (line(cameras={"left": camera(u_px=[float("nan")])}), "NaN is no number"),
        (line(cameras={"left": camera(u_px=[-float("inf")])}), "-Infinity is no number"),
        (line().replace(b"[1.5]", b"[1e999]"), "pixel must be finite"),
        (line(cameras={"left": camera(u_px=[1, 2])}), "differ in length: {'u_px': 2, 'v_px': 1"),
        (line(cameras={"left": camera(confidence=[2])}), "confidence must lie in (0, 1]"),
        (line(cameras={"left": camera(confidence=[1e300])}), "confidence must lie in (0, 1]"),
        (
            line(cameras={"left": camera(point_index=[0.5])}),
            "point_index.0: Input should be a valid integer, found 0.5",
        ),
        (
            line(cameras={"left": camera(point_index=[2**63])}),
            "point_index.0: Input should be less than 9223372036854775808",
        ),
        (line(cameras={"left": camera(i_uu_px=[1])}), "has only ['i_uu_px'] of"),
        (
            line(cameras={str(i): camera(0) for i in range(1001)}),
            "cameras: Dictionary should have at most 1000 items",
        ),
        (line(metadata=[]), "metadata: Input should be a JSON object, found []"),
        (
            line(metadata={"systematic_rotation_rad": "x"}),
            "must be a number from 0 to 3.14, found 'x'",
        ),
        (
            line(metadata={"systematic_rotation_rad": 10**400}),
            "must be a number from 0 to 3.14, found 1000",
        ),
        (line(metadata={"k": json.loads("[" * 40 + "]" * 40)}), "more than 32 levels"),
    ],
)
def test_a_wrong_line_is_refused_and_the_next_one_read(wrong: bytes, message: str) -> None:
    assert message in refusal(wrong)


def test_a_line_that_is_too_long_is_refused_without_being_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(stream_lines, "MAX_LINE_BYTES", 100_000)
    long = b'{"frame": "' + b"x" * 1_000_000 + b'"}'
    assert "is longer than 100000 bytes" in refusal(long)
    # Neither does one byte too many pass, nor is one that just fits refused.
    fits = line()[:-1].ljust(100_000)
    assert said(of_bytes(fits)) == [7]
    assert "is longer than" in refusal(fits + b" ")
    assert len(said(of_bytes(long))) == 1


def test_json_lines_cut_or_damaged_anywhere_raise_nothing() -> None:
    data = line(1) + line(2)
    for cut in range(len(data)):
        items = said(of_bytes(data[:cut]))
        assert items[: cut // len(line(1))] == [1][: cut // len(line(1))]
        assert len(items) <= 2
    rng = np.random.default_rng(0)
    for _ in range(500):
        flipped = np.frombuffer(data, np.uint8).copy()
        flipped[rng.integers(0, len(data), rng.integers(1, 4))] = rng.integers(256)
        for item in of_bytes(flipped.tobytes()):
            assert isinstance(item, StreamFrame) or "\n" not in item.message


# Waiting and stopping


@pytest.fixture
def pipe() -> Iterator[tuple[BinaryIO, BinaryIO]]:
    """The reading and the writing end of a pipe."""
    reading, writing = os.pipe()
    with os.fdopen(reading, "rb") as reader, os.fdopen(writing, "wb", buffering=0) as writer:
        yield reader, writer


def test_a_complete_line_is_given_while_the_next_is_being_written(
    pipe: tuple[BinaryIO, BinaryIO],
) -> None:
    reader, writer = pipe
    frames = frames_of("-", stdin=reader)
    for number in range(3):
        writer.write(line(number) + b'{"fra')
        assert said([next(frames)]) == [number]
        writer.write(b"me\n")
        assert "is not JSON" in str(said([next(frames)])[0])


def test_a_complete_arrow_batch_is_given_before_the_next_comes(
    pipe: tuple[BinaryIO, BinaryIO],
) -> None:
    reader, writer = pipe
    one = to_arrow(table([0]))
    frames = frames_of("-", stdin=reader)
    with ipc.new_stream(pa.PythonFile(writer, mode="w"), one.schema) as arrow:
        for number in range(3):
            arrow.write_table(spoilt(one, "frame", 0, number))
            assert said([next(frames)]) == [number]
    writer.close()
    assert said(frames) == []


@pytest.mark.parametrize(
    "begin", [b"", line(1), line(1) + b'{"half', arrow_stream(to_arrow(table([1])))[:-8]]
)
def test_a_waiting_stream_ends_when_it_is_stopped(
    begin: bytes, pipe: tuple[BinaryIO, BinaryIO]
) -> None:
    reader, writer = pipe
    writer.write(begin)
    until = float("inf")
    frames = frames_of("-", stdin=reader, stop=lambda: time.monotonic() > until)
    if begin:
        assert said([next(frames)]) == [1]
    until = time.monotonic() + 0.05
    assert said(frames) == []
    assert time.monotonic() < until + 5 * streams.POLL_S


def test_a_stopped_stream_gives_no_more_of_what_it_has() -> None:
    stopped: list[int] = []
    three = io.BytesIO(line(1) + line(2) + line(3))
    frames = frames_of("-", stdin=three, stop=lambda: len(stopped) > 0)
    assert said([next(frames)]) == [1]
    stopped.append(1)
    assert said(frames) == []


@pytest.mark.parametrize("begin", [line(1), arrow_stream(to_arrow(table([1])))[:-8]])
def test_a_signal_ends_the_waiting_for_standard_input(begin: bytes) -> None:
    program = """
        import signal, sys
        from calibgraph.tracking.streams import frames_of
        stopped = []
        signal.signal(signal.SIGTERM, lambda *_: stopped.append(1))
        for item in frames_of("-", stop=lambda: bool(stopped)):
            print(item, flush=True)
        print("ended", flush=True)
    """
    with subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(program)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ) as process:  # fmt: skip
        assert process.stdin and process.stdout and process.stderr
        process.stdin.write(begin)
        process.stdin.flush()
        assert b"StreamFrame(frame=1" in process.stdout.readline()
        process.send_signal(signal.SIGTERM)
        assert process.stdout.readline() == b"ended\n"
        assert process.wait() == 0
        assert process.stderr.read() == b""


# Sources


def test_a_source_is_what_it_looks_like(tmp_path: Path) -> None:
    table([3]).save(tmp_path / "a.parquet")
    assert said(frames_of(tmp_path)) == [3]
    assert said(frames_of(str(tmp_path / "a.parquet"))) == [3]
    assert said(frames_of("-", stdin=io.BytesIO(line(4)))) == [4]


def test_a_source_that_is_none_is_refused_at_once(tmp_path: Path) -> None:
    table([3]).save(tmp_path / "a.parquet")
    os.mkfifo(tmp_path / "pipe")
    calls: dict[str, Callable[[], object]] = {
        "missing.parquet: cannot be read": lambda: frames_of(tmp_path / "missing.parquet"),
        "cannot be read": lambda: frames_of("x" * 300),
        "is neither a file nor a folder": lambda: frames_of(tmp_path / "pipe"),
        "only a folder can be followed": lambda: frames_of(tmp_path / "a.parquet", follow=True),
    }
    for message, call in calls.items():
        with pytest.raises(FileError, match=message):
            call()


def test_a_closed_or_unreadable_stream_is_refused_in_one_line() -> None:
    closed = io.BytesIO()
    closed.close()
    assert "standard input: cannot be read" in str(said(frames_of("-", stdin=closed))[0])

    class Broken(io.BytesIO):
        def read1(self, size: int | None = -1, /) -> bytes:
            raise OSError("the wire is cut")

    (refused,) = said(frames_of("-", stdin=Broken()))
    assert refused == "standard input: cannot be read (the wire is cut); restart"
