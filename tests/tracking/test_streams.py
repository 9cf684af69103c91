"""Sources of frames: folders, pipes, what is refused at once."""

from __future__ import annotations

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
from calibgraph.tracking.streams import frames_of
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
