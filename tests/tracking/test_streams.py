"""Sources of frames: folders, pipes, what is refused at once."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

import pytest

from calibgraph import FileError
from calibgraph.tracking import streams
from calibgraph.tracking.streams import StreamFrame, frames_of
from tests.tracking.stream_data import (
    line,
    outcomes,
    table,
)

# Folders


def test_a_folder_gives_its_tables_in_the_order_of_their_names(tmp_path: Path) -> None:
    for name, numbers in {"b.csv": [1, 2], "a.parquet": [5], ".hidden.parquet": [9]}.items():
        table(numbers).save(tmp_path / name)
    (tmp_path / "notes.txt").write_text("no table")
    (tmp_path / "c.parquet").write_bytes(b"half")
    *frames, refused = outcomes(frames_of(tmp_path))
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
        return None if item is None else outcomes([item])[0]


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
        messages,
        ["a.parquet: cannot", "b.parquet: is no file", "c.parquet: is a folder"],
        strict=True,
    ):
        assert message.startswith(expected)
    assert following.next(seconds=0.1) is None


@pytest.mark.usefixtures("quick")
def test_a_followed_folder_that_goes_away_ends_in_one_line(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    frames = frames_of(folder, follow=True)
    folder.rmdir()
    (refused,) = outcomes(frames)
    assert "the folder cannot be read any more" in str(refused)


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
        assert outcomes([next(frames)]) == [number]
        writer.write(b"me\n")
        assert "is not JSON" in str(outcomes([next(frames)])[0])


@pytest.mark.parametrize("begin", [b"", line(1), line(1) + b'{"half'])
def test_a_waiting_stream_ends_when_it_is_stopped(
    begin: bytes, pipe: tuple[BinaryIO, BinaryIO]
) -> None:
    reader, writer = pipe
    writer.write(begin)
    until = float("inf")
    frames = frames_of("-", stdin=reader, stop=lambda: time.monotonic() > until)
    if begin:
        assert outcomes([next(frames)]) == [1]
    until = time.monotonic() + 0.05
    assert outcomes(frames) == []
    assert time.monotonic() < until + 5 * streams.POLL_S


def test_a_stopped_stream_gives_no_more_of_what_it_has() -> None:
    stopped: list[int] = []
    three = io.BytesIO(line(1) + line(2) + line(3))
    frames = frames_of("-", stdin=three, stop=lambda: len(stopped) > 0)
    assert outcomes([next(frames)]) == [1]
    stopped.append(1)
    assert outcomes(frames) == []


def test_a_signal_ends_the_waiting_for_standard_input() -> None:
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
        process.stdin.write(line(1))
        process.stdin.flush()
        assert b"StreamFrame(frame=1" in process.stdout.readline()
        process.send_signal(signal.SIGTERM)
        assert process.stdout.readline() == b"ended\n"
        assert process.wait() == 0
        assert process.stderr.read() == b""


# Sources


def test_a_source_is_what_it_looks_like(tmp_path: Path) -> None:
    table([3]).save(tmp_path / "a.parquet")
    assert outcomes(frames_of(tmp_path)) == [3]
    assert outcomes(frames_of(str(tmp_path / "a.parquet"))) == [3]
    assert outcomes(frames_of("-", stdin=io.BytesIO(line(4)))) == [4]


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
    assert "standard input: cannot be read" in str(outcomes(frames_of("-", stdin=closed))[0])

    class Broken(io.BytesIO):
        def read1(self, size: int | None = -1, /) -> bytes:
            raise OSError("the wire is cut")

    (refused,) = outcomes(frames_of("-", stdin=Broken()))
    assert refused == "standard input: cannot be read (the wire is cut); restart"
