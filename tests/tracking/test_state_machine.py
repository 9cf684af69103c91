"""Whatever happens to the tracker's state on disk: what was acknowledged is there, or refused."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import mkdtemp

import pytest
from hypothesis import HealthCheck, settings
from hypothesis.stateful import RuleBasedStateMachine, rule, run_state_machine_as_test
from hypothesis.strategies import booleans, floats, integers, lists, sampled_from

from calibgraph.errors import FileError
from calibgraph.tracking.state_database import DATABASE, StateDatabase
from tests.tracking.state_data import (
    LOG,
    Files,
    content,
    filled,
    held,
    recovered,
    require_usable,
    restored,
)

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

    def __init__(self, memory: Path) -> None:
        super().__init__()
        self.folder = Path(mkdtemp(dir=memory)) / "state"
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


def test_what_was_acknowledged_is_there_after_kills_full_disks_and_damage(memory: Path) -> None:
    run_state_machine_as_test(
        partial(Journal, memory),
        settings=settings(
            max_examples=80,
            stateful_step_count=20,
            derandomize=True,
            database=None,
            deadline=None,
            suppress_health_check=list(HealthCheck),
        ),
    )


def test_a_state_that_a_full_disk_hides_is_not_called_damaged(memory: Path) -> None:
    truth = filled(memory / "state", 5)
    full = pytest.raises(FileError, match="cannot be read .*: is the disk full")
    with file_size_limit(1000), full:
        StateDatabase(memory / "state")
    require_usable(memory / "state", truth)
