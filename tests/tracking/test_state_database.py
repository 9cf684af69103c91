"""The tracker's state on disk: power cuts, kills, damaged rows, files of others, and the lock."""

from __future__ import annotations

import os
import resource
import sqlite3
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from tempfile import mkdtemp

import pytest
from hypothesis import HealthCheck, settings
from hypothesis.stateful import RuleBasedStateMachine, rule, run_state_machine_as_test
from hypothesis.strategies import booleans, floats, integers, lists, sampled_from

from calibgraph.errors import FileError
from calibgraph.tracking.state_database import DATABASE, Recovered, StateDatabase
from tests.tracking.state_data import (
    LOG,
    Files,
    content,
    filled,
    held,
    opened,
    recovered,
    require_refused,
    require_usable,
    restored,
)


def test_the_folder_does_not_grow_with_the_number_of_snapshots(tmp_path: Path) -> None:
    with opened(tmp_path) as database:
        for _ in range(60):
            database.append(os.urandom(10_000))
            database.snapshot(os.urandom(100_000))
    assert sum(map(len, content(tmp_path).values())) < 1_000_000


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


def test_every_commit_is_synced(tmp_path: Path) -> None:
    """What the guarantee against power cuts rests on, by SQLite's documentation."""
    with opened(tmp_path) as database:
        database.append(b"first")
        for pragma, expected in (
            ("journal_mode", "wal"),
            ("synchronous", 2),
            ("locking_mode", "exclusive"),
        ):
            found = database._connection.execute(f"PRAGMA {pragma}").fetchone()
            assert found == (expected,), pragma


def test_what_a_crash_left_of_a_new_database_is_removed(tmp_path: Path) -> None:
    restored(tmp_path, {".writing-a.sqlite": b"half", ".writing-a.sqlite-journal": b"half"})
    assert recovered(tmp_path) == Recovered(None, (), ())
    assert set(content(tmp_path)) == {"lock", DATABASE}


ACKNOWLEDGING = """
import os, random, signal, sys, time
from pathlib import Path
from calibgraph.tracking.state_database import StateDatabase

def work(folder, round, first):
    database = StateDatabase(folder)
    result = database.recovered
    assert not result.damages, result.damages
    lines = (result.snapshot or b"").splitlines() + list(result.inputs)
    while True:
        line = b"%d %d %s" % (len(lines), round, b"x" * random.randrange(50_000))
        database.append(line)
        lines.append(line)
        os.write(1, line.rsplit(b" ", 1)[0] + b"\\n")
        os.write(first, b"x")
        if random.random() < 0.2:
            database.snapshot(b"\\n".join(lines))

random.seed(5)
StateDatabase(Path(sys.argv[1])).close()
for round in range(int(sys.argv[2])):
    ready, first = os.pipe()
    child = os.fork()
    if child == 0:
        work(Path(sys.argv[1]), round, first)
    os.close(first)
    os.read(ready, 1)  # it has acknowledged one, however busy the machine is
    time.sleep(random.uniform(0, 0.2))
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


def edited(folder: Path, statements: str) -> None:
    with closing(sqlite3.connect(folder / DATABASE, isolation_level=None)) as database:
        database.executescript(statements)


BOMB = "hex(zeroblob(100000000))"  # what it makes of a query takes memory
SCHEMAS = (
    f"CREATE TRIGGER t AFTER INSERT ON journal BEGIN SELECT {BOMB}; END",
    "CREATE INDEX i ON journal (hex(number))",
    f"ALTER TABLE journal ADD COLUMN c AS ({BOMB})",
    f"CREATE VIEW v AS SELECT {BOMB}",
    "ALTER TABLE snapshot RENAME TO other",
    "DROP TABLE status",
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
        ("PRAGMA user_version=3", "is state of layout 3, expected 2; choose another folder, or"),
        ("PRAGMA application_id=5", "is a database of another program; choose another folder"),
        *((change, "holds other tables than a tracker's") for change in SCHEMAS),
        ("PRAGMA writable_schema=ON; UPDATE sqlite_schema SET rootpage = 3", "is damaged"),
    ],
)
def test_damaged_rows_and_databases_of_others_are_refused(
    tmp_path: Path, statement: str, match: str
) -> None:
    filled(tmp_path, 8)
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


def test_two_cannot_have_one_folder(tmp_path: Path) -> None:
    busy = pytest.raises(FileError, match="is in use by another process; stop that one")
    with opened(tmp_path), busy:
        StateDatabase(tmp_path)
    filled(tmp_path, 1)


PLACES = floats(0, 1, exclude_max=True)


@contextmanager
def file_size_limit(limit_bytes: int) -> Iterator[None]:
    """The system lets no file grow beyond a size, as if the disk were full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


class Journal(RuleBasedStateMachine):
    """A database, and beside it all that it has acknowledged."""

    def __init__(self, tmp_path: Path) -> None:
        super().__init__()
        self.folder = Path(mkdtemp(dir=tmp_path)) / "state"
        self.count, self.done = 0, b""
        self.database = StateDatabase(self.folder)

    def teardown(self) -> None:
        self.database.close()

    def new(self, size: int) -> bytes:
        self.count += 1
        return b"%06d" % self.count + bytes(size)

    def killed(self) -> Files:
        """The files as a kill leaves them."""
        files = content(self.folder)
        self.database.close()
        return files

    def reopen(self) -> None:
        self.database = StateDatabase(self.folder)
        assert held(self.database.recovered) == self.done
        assert self.database.recovered.damages == ()

    @rule(sizes=lists(sampled_from([0, 100, 60_000]), min_size=1, max_size=3))
    def append(self, sizes: list[int]) -> None:
        records = [self.new(size) for size in sizes]
        self.database.append(*records)
        self.done += b"".join(records)

    @rule()
    def snapshot(self) -> None:
        self.database.snapshot(self.done)

    @rule()
    def restart(self) -> None:
        self.database.close()
        self.reopen()

    @rule()
    def kill(self) -> None:
        files = self.killed()
        restored(self.folder, files)
        self.reopen()
        assert content(self.folder) == files  # opening alone changes nothing

    @rule(room=integers(0, 200_000), takes_snapshot=booleans())
    def fill_the_disk(self, room: int, takes_snapshot: bool) -> None:
        record = self.new(100_000)
        size = max(path.stat().st_size for path in self.folder.iterdir())
        with file_size_limit(size + room):
            try:
                if takes_snapshot:
                    self.database.snapshot(self.done)
                else:
                    self.database.append(record)
                    self.done += record
            except OSError as error:
                assert error.filename == str(self.folder / DATABASE)
                assert "free or mend the disk and start again" in str(error)
                with pytest.raises(ValueError, match="is closed"):
                    self.database.append(record)
            self.database.close()
        self.database = StateDatabase(self.folder)
        found = held(self.database.recovered)
        assert found in (self.done, self.done + record)
        self.done = found
        self.append([0])  # ends the warning of a log that closing could not end

    @rule(place=PLACES, is_cut=booleans())
    def damage_the_log(self, place: float, is_cut: bool) -> None:
        """To SQLite it is a log that a crash has cut short; the inputs before are there."""
        files = self.killed()
        log = files.get(LOG, b"")
        restored(self.folder, files | ({LOG: damaged(log, place, is_cut)} if log else {}))
        try:
            self.database = StateDatabase(self.folder)
        except FileError:  # older pages of the log with newer ones of the database
            restored(self.folder, files)
            self.reopen()
        else:
            found = held(self.database.recovered)
            assert self.done.startswith(found)
            self.done = found
            self.append([0])  # ends the warning of a log that is missing

    @rule(place=PLACES, is_cut=booleans())
    def damage_the_database(self, place: float, is_cut: bool) -> None:
        self.database.close()
        files = content(self.folder)
        wrong = files | {DATABASE: damaged(files[DATABASE], place, is_cut)}
        restored(self.folder, wrong)
        try:
            assert held(recovered(self.folder)) == self.done
            assert LOG in files or not is_cut
        except FileError as error:
            assert "\n" not in str(error) and str(self.folder) in str(error)
            assert content(self.folder) | {"lock": b""} == wrong | {"lock": b""}
        restored(self.folder, files)
        self.reopen()


def damaged(data: bytes, place: float, is_cut: bool) -> bytes:
    """Cut short, or with another byte, at a share of the length."""
    at = int(place * len(data))
    return data[:at] + (b"" if is_cut else bytes([data[at] ^ 0xFF]) + data[at + 1 :])


def test_what_was_acknowledged_is_there_after_kills_full_disks_and_damage(tmp_path: Path) -> None:
    run_state_machine_as_test(
        partial(Journal, tmp_path),
        settings=settings(
            max_examples=80,
            stateful_step_count=20,
            derandomize=True,
            database=None,
            deadline=None,
            suppress_health_check=list(HealthCheck),
        ),
    )


def test_a_state_that_a_full_disk_hides_is_not_called_damaged(tmp_path: Path) -> None:
    truth = filled(tmp_path / "state", 5)
    full = pytest.raises(FileError, match="cannot be read .*: is the disk full")
    with file_size_limit(1000), full:
        StateDatabase(tmp_path / "state")
    require_usable(tmp_path / "state", truth)
