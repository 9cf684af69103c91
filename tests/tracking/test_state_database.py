"""The tracker's state on disk, under kills, power cuts, failing writes and damage.

The "state" in these tests is all inputs so far, one after the other: so what a folder holds, its
snapshot and the inputs after it, is comparable with the truth byte by byte.
"""

from __future__ import annotations

import os
import resource
import signal
import sqlite3
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest

from calibgraph.errors import FileError
from calibgraph.tracking.state_database import DATABASE, Recovered, StateDatabase

INPUT_BYTES = 3
LOG = f"{DATABASE}-wal"
Files = dict[str, bytes]


def inputs(number: int, *, first: int = 0) -> list[bytes]:
    return [f"{i:0{INPUT_BYTES}d}".encode() for i in range(first, first + number)]


def drive(
    database: StateDatabase, number: int, *, done: bytes = b"", snapshot_every: int = 3
) -> Iterator[bytes]:
    """Append inputs, with a snapshot now and then; yields all that is acknowledged each time."""
    for count, record in enumerate(inputs(number, first=len(done) // INPUT_BYTES), start=1):
        database.append(record)
        done += record
        yield done
        if count % snapshot_every == 0:
            database.snapshot(done)


@contextmanager
def opened(folder: Path) -> Iterator[StateDatabase]:
    with closing(StateDatabase(folder)) as database:
        yield database


def filled(folder: Path, number: int, *, snapshot_every: int = 3) -> bytes:
    """A folder after a number of inputs; returns the truth it should hold."""
    with opened(folder) as database:
        database.snapshot(b"")
        return list(drive(database, number, snapshot_every=snapshot_every))[-1]


def crashed(folder: Path, number: int) -> tuple[Files, bytes]:
    """The files of a folder after a number of inputs, as a kill leaves them; and the truth."""
    with opened(folder) as database:
        database.snapshot(b"")
        truth = list(drive(database, number))[-1]
        return content(folder), truth


def recovered(folder: Path) -> Recovered:
    with opened(folder) as database:
        return database.recovered


def held(result: Recovered) -> bytes:
    return (result.snapshot or b"") + b"".join(result.inputs)


def content(folder: Path) -> Files:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def restored(folder: Path, files: Files) -> Path:
    folder.mkdir(exist_ok=True)
    for path in folder.iterdir():
        path.unlink()
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return folder


@pytest.fixture
def memory() -> Iterator[Path]:
    """A folder in memory, where thousands of databases are opened: syncing costs nothing there."""
    place = "/dev/shm" if Path("/dev/shm").is_dir() else None
    with tempfile.TemporaryDirectory(dir=place) as folder:
        yield Path(folder)


def require_usable(folder: Path, truth: bytes) -> None:
    """A folder holds the truth, without damage, and takes more."""
    with opened(folder) as database:
        assert (held(database.recovered), database.recovered.damages) == (truth, ())
        *_, truth = drive(database, 4, done=truth)
    assert held(recovered(folder)) == truth


def require_refused(folder: Path, match: str) -> None:
    """A folder is refused in one line, and no byte of it is changed."""
    before = content(folder)
    with pytest.raises(FileError, match=match) as refused:
        StateDatabase(folder)
    assert "\n" not in str(refused.value)
    assert content(folder) | {"lock": b""} == before | {"lock": b""}


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
    for length in [*range(first, len(new), 61), len(new)]:
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
    kills = int(os.environ.get("CALIBGRAPH_TEST_KILLS", "10"))
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
    for limit in range(20_000, 80_000, 997):
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
            assert limit > 40_000
            return
    pytest.fail("no limit was large enough")


def test_a_full_disk_is_reported_as_one(tmp_path: Path) -> None:
    with opened(tmp_path) as database:
        database.append(b"first")
        assert database._connection is not None
        database._connection.execute("PRAGMA max_page_count=1")
        with pytest.raises(OSError, match=r"No space|full") as error:
            database.append(b"x" * 100_000)
    assert error.value.errno == 28
    assert recovered(tmp_path) == Recovered(None, (b"first",), ())


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
    places = {*range(110), *rng.choice(used, 400).tolist(), *rng.choice(len(data), 100).tolist()}
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
    """SQLite cannot tell it from a log that a crash has cut short: nothing false comes back."""
    files, truth = crashed(memory / "state", 8)
    log = files[LOG]
    lengths = set()
    for at in range(0, len(log), 97):
        for damaged in (log[:at], flipped(log, at)):
            result = recovered(restored(memory / "copy", files | {LOG: damaged}))
            assert truth.startswith(held(result))
            lengths.add(len(held(result)))
    assert lengths == {*range(0, len(truth), INPUT_BYTES)}


def test_a_log_that_is_missing_is_reported(tmp_path: Path) -> None:
    files, _ = crashed(tmp_path / "state", 8)
    del files[LOG]
    folder = restored(tmp_path / "copy", files)
    (line,) = recovered(folder).damages
    assert line.startswith(f"{folder / LOG}: is missing, updates may be lost")
    with opened(folder) as database:
        database.append(b"abc")
    assert recovered(folder).damages == ()


def test_a_database_that_is_missing_beside_its_log_is_refused(tmp_path: Path) -> None:
    files, _ = crashed(tmp_path / "state", 8)
    del files[DATABASE]
    require_refused(restored(tmp_path / "copy", files), "is missing, and its log is there")


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
        f"{tmp_path / DATABASE}: the snapshot after update 6 is damaged: not used",
    )


@pytest.mark.parametrize(
    ("statement", "match"),
    [
        ("UPDATE snapshot SET content = x'00'", "no snapshot has the right checksum"),
        ("UPDATE snapshot SET content = 'text'", "no snapshot has the right checksum"),
        ("UPDATE journal SET content = x'00' WHERE number = 8", "update 8 is missing or has a"),
        ("UPDATE journal SET digest = zeroblob(32) WHERE number = 7", "update 7 is missing or"),
        ("UPDATE journal SET number = 9 WHERE number = 7", "update 7 is missing or has a wrong"),
        ("DELETE FROM journal WHERE number = 7", "update 7 is missing or has a wrong checksum"),
        ("DROP TABLE journal", "is damaged"),
        ("DELETE FROM status", "is damaged"),
        ("UPDATE status SET number = 9", "update 9 is missing"),
        ("UPDATE status SET number = 7", "is damaged"),
    ],
)
def test_damaged_rows_are_refused(tmp_path: Path, statement: str, match: str) -> None:
    filled(tmp_path, 8)
    edited(tmp_path, statement)
    require_refused(tmp_path, match)


def test_another_folders_log_is_not_taken_for_ones_own(tmp_path: Path) -> None:
    files, _ = crashed(tmp_path / "one", 5)
    other, _ = crashed(tmp_path / "other", 9)
    folder = restored(tmp_path / "copy", files | {LOG: b"", DATABASE: other[DATABASE]})
    with pytest.MonkeyPatch.context():
        result = recovered(folder)
    assert held(result) == b"" and "is missing" in result.damages[0]


# Files of others.


@pytest.mark.parametrize("name", ["snapshot-000001.state", "journal-000002.log"])
def test_a_folder_of_the_earlier_layout_is_refused(tmp_path: Path, name: str) -> None:
    restored(tmp_path, {name: b"calibgraph-tracker/1\nwhatever"})
    require_refused(
        tmp_path, f"{name}: is state of the earlier layout .*; choose another folder, or continue"
    )


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


@pytest.mark.parametrize("data", [b"", b"half", b"no database at all" * 1000])
def test_a_file_that_is_no_database_is_refused(tmp_path: Path, data: bytes) -> None:
    restored(tmp_path, {DATABASE: data})
    require_refused(tmp_path, "is damaged or no tracker's state; choose another folder")


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


def test_a_second_writer_is_refused_until_the_first_is_closed(tmp_path: Path) -> None:
    with opened(tmp_path), pytest.raises(FileError, match="is in use"):
        StateDatabase(tmp_path)
    filled(tmp_path, 1)


def test_a_database_that_another_program_has_locked_is_left_alone(tmp_path: Path) -> None:
    truth = filled(tmp_path, 5)
    with closing(sqlite3.connect(tmp_path / DATABASE, isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        with opened(tmp_path) as database, pytest.raises(OSError, match="database is locked"):
            database.append(b"abc")
    require_usable(tmp_path, truth)
