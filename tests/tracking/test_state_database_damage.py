"""The tracker's state on disk: damage, files of others, and the lock."""

from __future__ import annotations

import signal
import sqlite3
import struct
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from calibgraph.errors import FileError
from calibgraph.tracking.state_database import DATABASE, StateDatabase
from tests.tracking.state_data import (
    INPUT_BYTES,
    LOG,
    content,
    crashed,
    filled,
    held,
    recovered,
    require_refused,
    restored,
)

# Damage.


def flipped(data: bytes, at: int, bits: int = 0xFF) -> bytes:
    changed = bytearray(data)
    changed[at] ^= bits
    return bytes(changed)


def check_damaged(folder: Path, truth: bytes) -> str:
    """Nothing false is returned, and a refusal changes nothing."""
    before = content(folder)
    try:
        result = recovered(folder)
    except FileError as error:
        assert "\n" not in str(error)
        assert str(folder) in str(error)
        assert content(folder) | {"lock": b""} == before | {"lock": b""}
        return "refused"
    assert held(result) == truth
    return "snapshot" if result.damages else "unused"


@pytest.mark.parametrize("bits", [0x01, 0xFF])
def test_a_changed_byte_of_the_database_is_refused_or_changes_nothing(
    memory: Path, bits: int
) -> None:
    truth = filled(memory / "state", 8)
    files = content(memory / "state")
    data = files[DATABASE]
    used = np.flatnonzero(np.frombuffer(data, np.uint8))
    rng = np.random.default_rng(bits)
    places = {*range(110), *rng.choice(used, 200).tolist(), *rng.choice(len(data), 50).tolist()}
    found = set()
    for at in sorted(places):
        folder = restored(memory / "copy", files | {DATABASE: flipped(data, at, bits)})
        found.add(check_damaged(folder, truth))
    assert found == {"refused", "snapshot", "unused"}


def test_a_database_cut_short_anywhere_is_refused(memory: Path) -> None:
    truth = filled(memory / "state", 8)
    files = content(memory / "state")
    data = files[DATABASE]
    for length in [*range(0, 120, 7), *range(120, len(data), 257)]:
        folder = restored(memory / "copy", files | {DATABASE: data[:length]})
        assert check_damaged(folder, truth) == "refused", length


def test_a_log_that_is_damaged_or_cut_short_costs_the_inputs_from_there_on_at_most(
    memory: Path,
) -> None:
    """To SQLite it is a log that a crash has cut short: nothing false comes back."""
    files, truth = crashed(memory / "state", 8)
    log = files[LOG]
    lengths = set()
    for at in range(0, len(log), 1021):
        for damaged in (log[:at], flipped(log, at)):
            result = recovered(restored(memory / "copy", files | {LOG: damaged}))
            assert truth.startswith(held(result))
            lengths.add(len(held(result)))
    assert lengths == {*range(0, len(truth), INPUT_BYTES)}


def edited(folder: Path, statement: str) -> None:
    with closing(sqlite3.connect(folder / DATABASE, isolation_level=None)) as database:
        database.execute(statement)


def test_a_damaged_snapshot_is_replaced_by_the_one_before_and_the_inputs_since(
    tmp_path: Path,
) -> None:
    truth = filled(tmp_path, 8)
    edited(tmp_path, "UPDATE snapshot SET content = x'00' WHERE number = 6")
    result = recovered(tmp_path)
    assert (result.snapshot, len(result.inputs)) == (truth[: 3 * INPUT_BYTES], 5)
    assert held(result) == truth
    assert result.damages == (
        f"{tmp_path / DATABASE}: the snapshot after input 6 is damaged: not used",
    )


@pytest.mark.parametrize(
    ("statement", "match"),
    [
        ("UPDATE snapshot SET content = x'00'", "no snapshot has the right checksum"),
        ("UPDATE snapshot SET content = 'text'", "no snapshot has the right checksum"),
        ("UPDATE journal SET content = x'00' WHERE number = 8", "input 8 is missing or has a"),
        ("UPDATE journal SET digest = zeroblob(32) WHERE number = 7", "input 7 is missing or"),
        ("UPDATE journal SET number = 9 WHERE number = 7", "input 7 is missing or has a wrong"),
        ("DELETE FROM journal WHERE number = 7", "input 7 is missing or has a wrong checksum"),
        ("DELETE FROM status", "is damaged"),
        ("UPDATE status SET number = 9", "input 9 is missing"),
        ("UPDATE status SET number = 7", "is damaged"),
    ],
)
def test_damaged_rows_are_refused(tmp_path: Path, statement: str, match: str) -> None:
    filled(tmp_path, 8)
    edited(tmp_path, statement)
    require_refused(tmp_path, match)


# Files of others.


@pytest.mark.parametrize(
    ("statement", "match"),
    [
        ("PRAGMA user_version=3", "is state of layout 3, expected 2; choose another folder, or"),
        ("PRAGMA application_id=5", "is a database of another program; choose another folder"),
    ],
)
def test_a_database_of_another_layout_or_program_is_refused(
    tmp_path: Path, statement: str, match: str
) -> None:
    filled(tmp_path, 5)
    edited(tmp_path, statement)
    require_refused(tmp_path, match)


def test_pages_that_refer_to_each_other_end_the_reading(tmp_path: Path) -> None:
    """A tree of 16 levels, each of a page with 3000 references to the next one: 10^55 rows."""
    filled(tmp_path, 5)
    data = bytearray((tmp_path / DATABASE).read_bytes())
    size, first = 32768, len(data) // 32768 + 1
    row = b"\x06\x00\x00\x00\x00\x0fx"  # a record of four NULLs and a text
    for level in range(17):
        last = level == 16
        cell = bytes([len(row), 1]) + row if last else struct.pack(">IB", first + level, 1)
        count = 1 if last else 3000
        starts = range(size - count * len(cell), size, len(cell))
        page = bytes(data[:100]) if level == 0 else b""
        page += struct.pack(">BHHHx", 13 if last else 5, 0, count, starts[0])
        page += (b"" if last else cell[:4]) + struct.pack(f">{count}H", *starts)
        page = page.ljust(starts[0], b"\0") + cell * count
        data = bytearray(page) + data[size:] if level == 0 else data + page
    data[28:32] = struct.pack(">I", len(data) // size)
    restored(tmp_path, {DATABASE: bytes(data)})
    require_refused(tmp_path, "is damaged")


@pytest.mark.parametrize("log", [b"", b"theirs"])
def test_files_beside_a_database_of_another_program_are_left_alone(
    tmp_path: Path, log: bytes
) -> None:
    with closing(sqlite3.connect(tmp_path / DATABASE)) as database:
        database.executescript("PRAGMA journal_mode=WAL; CREATE TABLE theirs (number INTEGER)")
    files = content(tmp_path) | {f"{DATABASE}-shm": b"theirs", LOG: log}
    require_refused(restored(tmp_path, files), "is a database of another program")


# The lock.


HOLDING = """
import sys
from pathlib import Path
from calibgraph.tracking.state_database import StateDatabase
database = StateDatabase(Path(sys.argv[1]))
print("locked", flush=True)
sys.stdin.read()
"""


def test_two_processes_cannot_have_one_folder(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HOLDING, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == b"locked\n"
        with pytest.raises(FileError, match="is in use by another process; stop that one"):
            StateDatabase(tmp_path)
        other.send_signal(signal.SIGKILL)
        other.wait()
    filled(tmp_path, 1)
