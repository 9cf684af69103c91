"""The tracker's state on disk: what comes back, after kills, power cuts and failing writes too."""

from __future__ import annotations

import os
import resource
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest

from calibgraph.errors import FileError
from calibgraph.tracking.state_database import DATABASE, StateDatabase
from calibgraph.tracking.state_recovery import Recovered
from tests.tracking.state_data import (
    INPUT_BYTES,
    LOG,
    Files,
    content,
    crashed,
    drive,
    filled,
    held,
    inputs,
    opened,
    recovered,
    require_usable,
    restored,
)

# What it does when nothing goes wrong.


def test_a_new_folder_holds_nothing(tmp_path: Path) -> None:
    assert recovered(tmp_path / "a" / "b") == Recovered(None, (), ())
    assert recovered(tmp_path / "a" / "b") == Recovered(None, (), ())


def test_inputs_come_back_in_order_without_a_snapshot(tmp_path: Path) -> None:
    records = [b"first", b"", b"\x00" * 100, os.urandom(60_000), b"last"]
    with opened(tmp_path) as database:
        for record in records:
            database.append(record)
    assert recovered(tmp_path) == Recovered(None, tuple(records), ())


def test_a_snapshot_replaces_the_inputs_before_it(tmp_path: Path) -> None:
    with opened(tmp_path) as database:
        database.append(b"before")
        database.snapshot(b"state")
        database.append(b"after")
    assert recovered(tmp_path) == Recovered(b"state", (b"after",), ())


def test_opening_does_not_change_what_is_held(tmp_path: Path) -> None:
    files, truth = crashed(tmp_path / "state", 5)
    folder = restored(tmp_path / "copy", files)
    for _ in range(2):
        assert held(recovered(folder)) == truth
        assert content(folder) == files


def test_two_snapshots_are_kept_and_the_inputs_since_the_older(tmp_path: Path) -> None:
    filled(tmp_path, 13)
    with closing(sqlite3.connect(tmp_path / DATABASE)) as database:
        snapshots = database.execute("SELECT number FROM snapshot").fetchall()
        journal = database.execute("SELECT number FROM journal ORDER BY number").fetchall()
    assert snapshots == [(9,), (12,)]
    assert journal == [(10,), (11,), (12,), (13,)]


def test_real_sizes_come_back(tmp_path: Path) -> None:
    state, records = os.urandom(5_000_000), tuple(os.urandom(60_000) for _ in range(100))
    with opened(tmp_path) as database:
        database.snapshot(state)
        for record in records:
            database.append(record)
    assert recovered(tmp_path) == Recovered(state, records, ())


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


def test_writing_after_closing_is_refused(tmp_path: Path) -> None:
    database = StateDatabase(tmp_path)
    database.close()
    database.close()
    for use in (lambda: database.append(b""), lambda: database.snapshot(b"")):
        with pytest.raises(ValueError, match="is closed"):
            use()


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


def test_a_kill_between_two_calls_keeps_every_acknowledged_input(tmp_path: Path) -> None:
    moments: list[tuple[Files, bytes]] = []
    with opened(tmp_path / "state") as database:
        for done in drive(database, 10):
            moments.append((content(tmp_path / "state"), done))
    for files, done in moments:
        require_usable(restored(tmp_path / "copy", files), done)


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


# Failing writes.


@contextmanager
def file_size_limit(limit_bytes: int) -> Iterator[None]:
    """The system lets no file grow beyond a size, as if the disk were full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_write_that_fails_at_any_byte_loses_no_acknowledged_input(memory: Path) -> None:
    for limit in range(20_000, 2_000_000, 14_983):
        folder = memory / str(limit)
        done, failed = b"", False
        database = StateDatabase(folder)
        with file_size_limit(limit):
            try:
                for done in drive(database, 7):  # noqa: B007 - read after a failure
                    pass
            except OSError as error:
                failed = True
                assert error.filename == str(folder / DATABASE)
                assert "free or mend the disk and start again" in str(error)
                for use in (lambda: database.append(b""), lambda: database.snapshot(b"")):  # noqa: B023
                    with pytest.raises(ValueError, match="is closed"):
                        use()
            database.close()
        result = recovered(folder)
        assert held(result) in (done, done + inputs(1, first=len(done) // INPUT_BYTES)[0])
        with opened(folder) as again:
            again.append(b"abc")
        assert recovered(folder).inputs[-1] == b"abc"
        if not failed:
            assert limit > 300_000
            return
    pytest.fail("no limit was large enough")


def test_a_state_that_a_full_disk_hides_is_not_called_damaged(memory: Path) -> None:
    truth = filled(memory / "state", 5)
    full = pytest.raises(FileError, match="cannot be read .*: is the disk full")
    with file_size_limit(1000), full:
        StateDatabase(memory / "state")
    require_usable(memory / "state", truth)


def test_an_interrupted_append_is_taken_back(tmp_path: Path) -> None:
    with opened(tmp_path) as database:
        database.append(b"first")
        with pytest.raises(KeyboardInterrupt), database._writing() as connection:
            connection.execute("INSERT INTO journal VALUES (2, x'00', x'00')")
            raise KeyboardInterrupt
        with pytest.raises(ValueError, match="is closed"):
            database.append(b"next")
    assert recovered(tmp_path) == Recovered(None, (b"first",), ())


def test_a_full_disk_is_reported_as_one(tmp_path: Path) -> None:
    with opened(tmp_path) as database:
        database.append(b"first")
        assert database._connection is not None
        database._connection.execute("PRAGMA max_page_count=1")
        with pytest.raises(OSError, match=r"No space|full") as error:
            database.append(b"x" * 100_000)
    assert error.value.errno == 28
    assert recovered(tmp_path) == Recovered(None, (b"first",), ())
