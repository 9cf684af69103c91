"""The tracker's state on disk: power cuts, kills, damaged rows, files of others, and the lock."""

from __future__ import annotations

import os
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
from calibgraph.tracking.state_recovery import Recovered
from tests.tracking.state_data import (
    INPUT_BYTES,
    LOG,
    content,
    drive,
    filled,
    held,
    opened,
    recovered,
    require_refused,
    require_usable,
    restored,
)

# What it does when nothing goes wrong.


def test_the_folder_does_not_grow_with_the_number_of_snapshots(memory: Path) -> None:
    with opened(memory) as database:
        for _ in range(60):
            database.append(os.urandom(10_000))
            database.snapshot(os.urandom(100_000))
    assert sum(map(len, content(memory).values())) < 1_000_000


def test_other_files_are_left_alone(tmp_path: Path) -> None:
    others = {"notes.txt": b"mine", "state.sqlite.bak": b"a copy", ".writing-a.yaml": b"theirs"}
    restored(tmp_path, others)
    truth = filled(tmp_path, 5)
    assert held(recovered(tmp_path)) == truth
    assert others.items() <= content(tmp_path).items()


def test_a_file_in_the_folders_place_is_refused(tmp_path: Path) -> None:
    (tmp_path / "state").write_bytes(b"")
    with pytest.raises(FileError, match="expected a folder"):
        StateDatabase(tmp_path / "state")


def test_a_folder_that_may_not_be_written_to_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write anywhere
    with pytest.raises(FileError, match="may not be written to"):
        StateDatabase(tmp_path / "state")


# Crashes.


def test_every_commit_is_synced(tmp_path: Path) -> None:
    """What the guarantee against power cuts rests on, by SQLite's documentation."""
    with opened(tmp_path) as database:
        database.append(b"first")
        assert database._connection is not None
        for pragma, expected in (
            ("journal_mode", "wal"),
            ("synchronous", 2),
            ("locking_mode", "exclusive"),
        ):
            found = database._connection.execute(f"PRAGMA {pragma}").fetchone()
            assert found == (expected,), pragma


def test_a_power_cut_during_an_append_keeps_every_acknowledged_input(memory: Path) -> None:
    """Of the bytes after the last sync, any may have reached the disk."""
    rng = np.random.default_rng(0)
    with opened(memory / "state") as database:
        *_, done = drive(database, 5)
        before = content(memory / "state")
        database.append(b"005")
        after = content(memory / "state")
    assert before[DATABASE] == after[DATABASE]
    old, new = (np.frombuffer(files[LOG], np.uint8) for files in (before, after))
    changed = np.flatnonzero(new[: len(old)] != old)
    first = changed[0] if len(changed) else len(old)
    seen = set()
    for length in [*range(first, len(new), 251), len(new)]:
        survivors = np.zeros(max(length, len(old)), np.uint8)
        survivors[: len(old)] = old
        survivors[first:length] = new[first:length]
        for spoil in (False, True):
            if spoil:  # sectors that did not reach the disk, in any order
                for sector in range(first // 512, length // 512):
                    if rng.random() < 0.3:
                        rows = slice(max(first, 512 * sector), min(length, 512 * sector + 512))
                        survivors[rows] = rng.integers(256)
            folder = restored(memory / "copy", after | {LOG: survivors.tobytes()})
            result = recovered(folder)
            assert result.damages == ()
            assert held(result) in (done, done + b"005")
            seen.add(held(result))
    assert seen == {done, done + b"005"}
    require_usable(folder, held(result))


def test_a_power_cut_during_a_checkpoint_keeps_every_acknowledged_input(memory: Path) -> None:
    """The log is whole then; of the pages that are copied from it, any may be on the disk."""
    rng = np.random.default_rng(0)
    with opened(memory / "state") as database:
        *_, done = drive(database, 8)
        assert database._connection is not None
        before = content(memory / "state")
        database._connection.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchall()
        after = content(memory / "state")
    assert before[LOG] == after[LOG] and before[DATABASE] != after[DATABASE]
    size = len(after[DATABASE])
    old = np.frombuffer(before[DATABASE].ljust(size, b"\0"), np.uint8).reshape(-1, 512)
    new = np.frombuffer(after[DATABASE], np.uint8).reshape(-1, 512)
    for _ in range(50):
        mixed = np.where(rng.random(len(old))[:, None] < 0.5, old, new)
        folder = restored(memory / "copy", before | {DATABASE: mixed.tobytes()})
        if mixed[0].tobytes() not in (old[0].tobytes(), new[0].tobytes()):
            continue
        assert recovered(folder).damages == ()
        require_usable(folder, done)


def test_what_a_crash_left_of_a_new_database_is_removed(tmp_path: Path) -> None:
    restored(tmp_path, {".writing-a.sqlite": b"half", ".writing-a.sqlite-journal": b"half"})
    assert recovered(tmp_path) == Recovered(None, (), ())
    assert set(content(tmp_path)) == {"lock", DATABASE}


ACKNOWLEDGING = """
import os, random, signal, sys, time
from pathlib import Path
from calibgraph.tracking.state_database import StateDatabase

def work(folder, round):
    database = StateDatabase(folder)
    result = database.recovered
    assert not result.damages, result.damages
    lines = (result.snapshot or b"").splitlines() + list(result.inputs)
    while True:
        line = b"%d %d %s" % (len(lines), round, b"x" * random.randrange(50_000))
        database.append(line)
        lines.append(line)
        os.write(1, line.rsplit(b" ", 1)[0] + b"\\n")
        if random.random() < 0.2:
            database.snapshot(b"\\n".join(lines))

random.seed(5)
StateDatabase(Path(sys.argv[1])).close()
for round in range(int(sys.argv[2])):
    child = os.fork()
    if child == 0:
        work(Path(sys.argv[1]), round)
    time.sleep(random.uniform(0.02, 0.25))
    os.kill(child, signal.SIGKILL)
    assert os.waitpid(child, 0)[1] == signal.SIGKILL, "it ended on its own"
"""


def test_every_input_acknowledged_before_a_sigkill_is_there(tmp_path: Path) -> None:
    kills = int(os.environ.get("CALIBGRAPH_TEST_KILLS", "5"))
    run = subprocess.run(
        [sys.executable, "-c", ACKNOWLEDGING, str(tmp_path), str(kills)],
        capture_output=True,
        check=True,
    )
    result = recovered(tmp_path)
    lines = (result.snapshot or b"").splitlines() + list(result.inputs)
    kept = [tuple(map(int, line.split()[:2])) for line in lines]
    acknowledged = [tuple(map(int, line.split())) for line in run.stdout.splitlines()]
    assert len(acknowledged) > kills
    assert set(acknowledged) <= set(kept)
    assert [number for number, _ in kept] == list(range(len(kept)))
    assert result.damages == ()


# Damage.


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
