"""The tracker's state on disk, under every crash and every damage.

The "state" in these tests is all inputs so far, one after the other: so what a folder tells, its
snapshot and the inputs after it, is comparable with the truth byte by byte.
"""

from __future__ import annotations

import errno
import itertools
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from calibgraph.errors import FileError
from calibgraph.tracking import store_format
from calibgraph.tracking.store import Recovered, Store

INPUT_BYTES = 3
Files = dict[str, bytes]
CALLS = ("open", "pwrite", "fsync", "ftruncate", "replace", "rename", "unlink", "chmod")
"""The calls of the system that change what is on disk, or when."""


def inputs(number: int, *, first: int = 0) -> list[bytes]:
    return [f"{i:0{INPUT_BYTES}d}".encode() for i in range(first, first + number)]


def drive(
    store: Store, number: int, *, done: bytes = b"", snapshot_every: int = 3
) -> Iterator[bytes]:
    """Append inputs, with a snapshot now and then; yields all that is acknowledged each time."""
    for count, record in enumerate(inputs(number, first=len(done) // INPUT_BYTES), start=1):
        store.append(record)
        done += record
        yield done
        if count % snapshot_every == 0:
            store.snapshot(done)


def filled(folder: Path, number: int, *, snapshot_every: int = 3) -> bytes:
    """A folder after a number of inputs; returns the truth it should tell."""
    with Store(folder) as store:
        store.recover()
        return list(drive(store, number, snapshot_every=snapshot_every))[-1]


def recovered(folder: Path) -> Recovered:
    with Store(folder) as store:
        return store.recover()


def told(result: Recovered) -> bytes:
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


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} - {"lock"}


@contextmanager
def before_every_call(hook: Callable[[str], None]) -> Iterator[None]:
    """Have ``hook`` called with the name of each call that changes the disk, before it is made."""

    def hooked(name: str) -> Callable[..., object]:
        real = getattr(os, name)

        def call(*args: object, **options: object) -> object:
            hook(name)
            return real(*args, **options)

        return call

    with pytest.MonkeyPatch.context() as patch:
        for name in CALLS:
            patch.setattr(os, name, hooked(name))
        yield


@pytest.fixture
def fast(monkeypatch: pytest.MonkeyPatch) -> None:
    """No waiting for the disk, where thousands of folders are read."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


def require_usable(folder: Path, truth: bytes) -> None:
    """A folder that was recovered tells the same again, without damage, and goes on from there."""
    with Store(folder) as store:
        again = store.recover()
        assert (told(again), again.damages) == (truth, ())
        *_, truth = drive(store, 4, done=truth)
    assert told(recovered(folder)) == truth


# What a store does when nothing goes wrong.


def test_a_new_folder_holds_nothing(tmp_path: Path) -> None:
    assert recovered(tmp_path / "a" / "b") == Recovered(None, (), ())
    assert recovered(tmp_path / "a" / "b") == Recovered(None, (), ())


def test_inputs_come_back_in_order_without_a_snapshot(tmp_path: Path) -> None:
    records = [b"first", b"", b"\x00" * 100, os.urandom(60_000), b"last"]
    with Store(tmp_path) as store:
        store.recover()
        for record in records:
            store.append(record)
    assert recovered(tmp_path) == Recovered(None, tuple(records), ())


def test_a_snapshot_replaces_the_inputs_before_it(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        store.recover()
        store.append(b"before")
        store.snapshot(b"state")
        store.append(b"after")
    assert recovered(tmp_path) == Recovered(b"state", (b"after",), ())


def test_recovering_twice_tells_the_same(tmp_path: Path) -> None:
    truth = filled(tmp_path, 5)
    with Store(tmp_path) as store:
        assert store.recover() == store.recover()
        store.append(b"abc")
        assert told(store.recover()) == truth + b"abc"


def test_two_generations_are_kept(tmp_path: Path) -> None:
    filled(tmp_path, 13)
    assert names(tmp_path) == {
        "snapshot-000003.state",
        "journal-000003.log",
        "snapshot-000004.state",
        "journal-000004.log",
    }


def test_real_sizes_come_back(tmp_path: Path) -> None:
    state, records = os.urandom(5_000_000), tuple(os.urandom(60_000) for _ in range(100))
    with Store(tmp_path) as store:
        store.recover()
        store.snapshot(state)
        for record in records:
            store.append(record)
    assert recovered(tmp_path) == Recovered(state, records, ())


def test_generations_of_more_than_six_digits_go_on(tmp_path: Path) -> None:
    chain = bytes(32)
    last = 999_999
    (tmp_path / f"snapshot-{last}.state").write_bytes(
        store_format.encode_snapshot(last, chain, b"old")
    )
    (tmp_path / f"journal-{last}.log").write_bytes(store_format.encode_journal_head(last, chain))
    with Store(tmp_path) as store:
        assert store.recover().snapshot == b"old"
        store.snapshot(b"new")
        store.append(b"abc")
    assert recovered(tmp_path) == Recovered(b"new", (b"abc",), ())
    assert "snapshot-1000000.state" in names(tmp_path)
    (tmp_path / "snapshot-1000000.state").write_bytes(b"bad")
    assert recovered(tmp_path).snapshot == b"old"


def test_foreign_files_are_left_alone(tmp_path: Path) -> None:
    foreign = {
        "notes.txt": b"mine",
        "journal-0000000.log": b"one zero too many",
        "journal-1.log": b"too few digits",
        "journal-000007.log.bak": b"a copy",
        "snapshot-000009.log": b"wrong ending",
        "snapshot-000009.state.damaged": b"found before",
        f"journal-{'9' * 50}.log": b"a number that fits nowhere",
        ".writing-abc.yaml": b"another program's",
    }
    restored(tmp_path, foreign)
    (tmp_path / "snapshot-000003.state").mkdir()
    truth = filled(tmp_path, 5)
    result = recovered(tmp_path)
    (tmp_path / "snapshot-000003.state").rmdir()
    assert (told(result), result.damages) == (truth, ())
    assert foreign.items() <= content(tmp_path).items()


def test_appending_before_recovering_or_after_closing_is_refused(tmp_path: Path) -> None:
    store = Store(tmp_path)
    with pytest.raises(ValueError, match=r"call recover\(\) first"):
        store.append(b"")
    store.recover()
    store.close()
    store.close()
    for use in (lambda: store.append(b""), lambda: store.snapshot(b""), store.recover):
        with pytest.raises(ValueError, match="is closed"):
            use()


def test_a_file_in_the_folders_place_is_told(tmp_path: Path) -> None:
    (tmp_path / "state").write_bytes(b"")
    with pytest.raises(FileError, match="expected a folder"):
        Store(tmp_path / "state")


# Crashes.


def test_a_kill_at_any_call_keeps_every_acknowledged_input(tmp_path: Path) -> None:
    moments: list[tuple[Files, bytes]] = []
    done = b""

    def remember(name: str) -> None:
        if (tmp_path / "state").exists():
            moments.append((content(tmp_path / "state"), done))

    with before_every_call(remember), Store(tmp_path / "state") as store:
        store.recover()
        for done in drive(store, 10):  # noqa: B007 - read by remember()
            pass
    check_moments(tmp_path / "copy", moments, truth=done)


def test_a_power_cut_at_any_call_keeps_every_acknowledged_input(tmp_path: Path) -> None:
    disk = Disk(tmp_path / "state")
    moments: list[tuple[Files, bytes]] = []
    done = b""

    def remember(name: str) -> None:
        moments.append((disk.synced(), done))
        moments.append((disk.named_but_unwritten(), done))

    with disk.watched(), before_every_call(remember), Store(tmp_path / "state") as store:
        store.recover()
        for done in drive(store, 10):  # noqa: B007 - read by remember()
            pass
    check_moments(tmp_path / "copy", moments, truth=done)


def test_what_is_recovered_survives_a_power_cut_right_after(tmp_path: Path) -> None:
    truth = filled(tmp_path / "state", 5)
    disk = Disk(tmp_path / "state")
    with disk.watched():
        assert told(recovered(tmp_path / "state")) == truth
    # The files that recovery had no need to write are whole; the journal is as it was synced.
    survivors = content(tmp_path / "state") | {
        name: disk.contents[inode]
        for name, inode in disk.names.items()
        if name == "journal-000001.log"
    }
    assert told(recovered(restored(tmp_path / "copy", survivors))) == truth


def check_moments(folder: Path, moments: list[tuple[Files, bytes]], *, truth: bytes) -> None:
    """Each crash leaves all that was acknowledged, and at most the input that was on its way."""
    assert len(moments) > 50
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        for files, done in moments:
            result = recovered(restored(folder, files))
            assert result.damages == ()
            assert told(result) in (done, truth[: len(done) + INPUT_BYTES])
            require_usable(folder, told(result))
            assert not [name for name in names(folder) if name.startswith(".writing")]


class Disk:
    """What of a folder survives a power cut: names and contents as of their last fsync."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.contents: dict[int, bytes] = {}
        self.names: dict[str, int] = {}
        self.held: list[int] = []

    @contextmanager
    def watched(self) -> Iterator[None]:
        real = os.fsync

        def fsync(descriptor: int) -> None:
            real(descriptor)
            self.held.append(os.dup(descriptor))  # so that no other file gets its number
            status = os.fstat(descriptor)
            if not os.path.isdir(f"/proc/self/fd/{descriptor}"):
                self.contents[status.st_ino] = os.pread(descriptor, status.st_size, 0)
            elif self.folder.exists() and os.path.samestat(status, self.folder.stat()):
                self.names = self.current_names()

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(os, "fsync", fsync)
            yield
        for descriptor in self.held:
            os.close(descriptor)

    def sync_all(self) -> None:
        self.names = self.current_names()
        for name, data in content(self.folder).items():
            self.contents[self.names[name]] = data

    def current_names(self) -> dict[str, int]:
        there = self.folder.iterdir() if self.folder.exists() else ()
        return {path.name: path.stat().st_ino for path in there}

    def synced(self) -> Files:
        return {name: self.contents.get(inode, b"") for name, inode in self.names.items()}

    def named_but_unwritten(self) -> Files:
        """The names have reached the disk on their own; what was not synced has not."""
        return {name: self.contents.get(i, b"") for name, i in self.current_names().items()}


@pytest.mark.usefixtures("fast")
def test_a_kill_while_recovering_changes_nothing(tmp_path: Path) -> None:
    for name, files in troubled_folders(tmp_path / "origin").items():
        expected = told(recovered(restored(tmp_path / "whole", files)))
        moments: list[Files] = []
        folder = restored(tmp_path / "state", files)
        with before_every_call(lambda _, at=folder, to=moments: to.append(content(at))):
            recovered(folder)
        assert moments
        for moment in moments:
            assert told(recovered(restored(tmp_path / "copy", moment))) == expected, name
            require_usable(tmp_path / "copy", expected)


@pytest.mark.usefixtures("fast")
def test_a_power_cut_while_recovering_changes_nothing(tmp_path: Path) -> None:
    for name, files in troubled_folders(tmp_path / "origin").items():
        expected = told(recovered(restored(tmp_path / "whole", files)))
        disk = Disk(restored(tmp_path / "state", files))
        disk.sync_all()
        moments: list[Files] = []

        def remember(_: str, disk: Disk = disk, moments: list[Files] = moments) -> None:
            moments.extend((disk.synced(), disk.named_but_unwritten()))

        with disk.watched(), before_every_call(remember):
            recovered(disk.folder)
        assert disk.names == disk.current_names(), name
        for moment in [*moments, disk.synced()]:
            assert told(recovered(restored(tmp_path / "copy", moment))) == expected, name


def troubled_folders(folder: Path) -> dict[str, Files]:
    """Folders in need of each kind of work at recovery."""
    filled(folder, 8)
    good = content(folder)
    last, journal, newest = "journal-000002.log", "journal-000001.log", "snapshot-000002.state"
    bad_snapshot = good | {newest: b"bad"}
    middle = flipped(good[last], len(good[last]) - 5 - INPUT_BYTES)
    return {
        "torn": good | {last: good[last][:-1]},
        "bad snapshot": bad_snapshot,
        "bad journal": good | {last: middle},
        "bad snapshot and journal": bad_snapshot | {journal: flipped(good[journal], -1)},
        "no journal": {name: data for name, data in good.items() if name != last},
        "bad head": good | {last: flipped(good[last], 30)},
        "nothing good": bad_snapshot | {"snapshot-000001.state": b"", last: b""},
        "half written": good | {".writing-a.log": b"x", ".writing-b.state": b"x"},
        "clean": good,
        "new": {},
    }


def flipped(data: bytes, at: int, bits: int = 0xFF) -> bytes:
    changed = bytearray(data)
    changed[at] ^= bits
    return bytes(changed)


ACKNOWLEDGING = """
import os, random, signal, sys, time
from pathlib import Path
from calibgraph.tracking.store import Store

def work(folder, round):
    store = Store(folder)
    result = store.recover()
    assert not result.damages, result.damages
    lines = (result.snapshot or b"").splitlines() + list(result.inputs)
    while True:
        line = b"%d %d %s" % (len(lines), round, b"x" * random.randrange(50_000))
        store.append(line)
        lines.append(line)
        os.write(1, line.rsplit(b" ", 1)[0] + b"\\n")
        if random.random() < 0.2:
            store.snapshot(b"\\n".join(lines))

random.seed(5)
for round in range(int(sys.argv[2])):
    child = os.fork()
    if child == 0:
        work(Path(sys.argv[1]), round)
    time.sleep(random.uniform(0.01, 0.06))
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


@pytest.mark.parametrize("forever", [False, True])
def test_a_failing_call_loses_no_acknowledged_input(tmp_path: Path, *, forever: bool) -> None:
    for fail_at in itertools.count():
        failing = Failing(fail_at, forever=forever)
        folder = tmp_path / str(fail_at)
        done, on_its_way = stubborn(folder, failing)
        result = recovered(folder)
        assert result.damages == ()
        assert told(result) in (done, done + on_its_way)
        require_usable(folder, told(result))
        if not failing.failed:
            assert fail_at > 30
            assert len(done) == 7 * INPUT_BYTES
            return


class Failing:
    """Lets a number of calls pass; the next one fails, or all from then on."""

    def __init__(self, passing: int, *, forever: bool) -> None:
        self.passing = passing
        self.forever = forever
        self.failed = False

    def __call__(self, name: str) -> None:
        self.passing -= 1
        if self.passing == -1 or (self.passing < 0 and self.forever):
            self.failed = True
            raise OSError(errno.ENOSPC, "No space left on device")


def stubborn(folder: Path, failing: Failing) -> tuple[bytes, bytes]:
    """Append whatever fails: what was acknowledged, and the input that may be there as well.

    An input whose append failed is only ever there if the store took no other after it.
    """
    done = on_its_way = b""
    with Store(folder) as store:
        store.recover()
        with before_every_call(failing):
            for record in inputs(7):
                try:
                    store.append(record)
                    done, on_its_way = done + record, b""
                    if len(done) % 2 == 0:
                        store.snapshot(done)
                except OSError:
                    on_its_way = on_its_way or record * (not done.endswith(record))
    return done, on_its_way


def with_one_input(folder: Path) -> Store:
    store = Store(folder)
    store.recover()
    store.append(b"first")
    return store


def test_an_append_on_a_full_disk_leaves_the_earlier_inputs_and_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with with_one_input(tmp_path) as store:
        with monkeypatch.context() as patch:
            fill_disk(patch)
            with pytest.raises(OSError, match="No space"):
                store.append(b"too long for what is left")
        assert recorded(tmp_path) == (b"first",)
        store.append(b"second")
    assert recovered(tmp_path) == Recovered(None, (b"first", b"second"), ())


def test_a_store_that_cannot_be_cut_back_refuses_until_the_restart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with with_one_input(tmp_path) as store:
        with monkeypatch.context() as patch:
            fill_disk(patch)
            patch.setattr(os, "ftruncate", failing_call)
            with pytest.raises(OSError, match="No space"):
                store.append(b"second")
        for use in (lambda: store.append(b"third"), lambda: store.snapshot(b"state")):
            with pytest.raises(OSError, match="free the disk and restart") as refused:
                use()
            assert refused.value.filename == str(tmp_path)
    assert recovered(tmp_path) == Recovered(None, (b"first",), ())


def test_an_interrupted_append_is_taken_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(descriptor: int) -> None:
        monkeypatch.undo()
        raise KeyboardInterrupt

    with Store(tmp_path) as store:
        store.recover()
        store.append(b"first")
        monkeypatch.setattr(os, "fsync", interrupt)
        with pytest.raises(KeyboardInterrupt):
            store.append(b"an input that the next one does not cover" * 9)
        store.append(b"next")
    assert recovered(tmp_path) == Recovered(None, (b"first", b"next"), ())


def fill_disk(patch: pytest.MonkeyPatch) -> None:
    """The disk takes half of a write, and no more."""
    real = os.pwrite
    taken: list[int] = []

    def half(descriptor: int, data: bytes, offset: int) -> int:
        if taken:
            failing_call()
        taken.append(real(descriptor, data[: len(data) // 2], offset))
        return taken[0]

    patch.setattr(os, "pwrite", half)


def failing_call(*_: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def recorded(folder: Path) -> tuple[bytes, ...]:
    """The inputs in the first journal, read past the lock."""
    journal = store_format.decode_journal((folder / "journal-000000.log").read_bytes(), 0)
    assert journal.fault is None
    return journal.records


# Damage.


@pytest.fixture
def small(tmp_path: Path) -> tuple[Files, bytes]:
    """A store of two generations with inputs in both journals, and its truth."""
    truth = filled(tmp_path / "small", 8)
    files = content(tmp_path / "small")
    del files["lock"]
    assert len(files) == 4
    return files, truth


@pytest.mark.usefixtures("fast")
@pytest.mark.parametrize("bits", [0x01, 0xFF])
def test_a_changed_byte_anywhere_is_told_or_changes_nothing(
    tmp_path: Path, small: tuple[Files, bytes], bits: int
) -> None:
    files, truth = small
    for name, data in files.items():
        for at in range(len(data)):
            damaged = files | {name: flipped(data, at, bits)}
            folder = restored(tmp_path / "copy", damaged)
            if store_format._MAGIC[:-1] == data[: at + 1] and bits == 0x01:
                with pytest.raises(FileError, match="calibgraph-tracker/0"):
                    recovered(folder)
                continue
            check_damaged(folder, truth, keeps=damaged[name], name=name)


@pytest.mark.usefixtures("fast")
def test_a_file_cut_short_anywhere_is_told_or_a_crash(
    tmp_path: Path, small: tuple[Files, bytes]
) -> None:
    files, truth = small
    for name, data in files.items():
        for length in range(len(data)):
            damaged = files | {name: data[:length]}
            folder = restored(tmp_path / "copy", damaged)
            if name == "journal-000002.log" and length >= 66:
                check_torn(folder, truth)
            elif name == "journal-000001.log" and length in (66, 113, 160):
                # Between two inputs, in a journal that only a damaged snapshot would need.
                assert told(recovered(folder)) == truth
            else:
                check_damaged(folder, truth, keeps=damaged[name], name=name)


def check_damaged(folder: Path, truth: bytes, *, keeps: bytes, name: str) -> None:
    """The damage is told, nothing false is, the bad file is kept, and the store goes on."""
    result = recovered(folder)
    (line,) = result.damages
    assert line.startswith(f"{folder / name}: ")
    assert f"renamed to {name}.damaged" in line
    assert "\n" not in line
    assert truth.startswith(told(result))
    if name != "journal-000002.log":
        assert told(result) == truth
    assert (folder / f"{name}.damaged").read_bytes() == keeps
    require_usable(folder, told(result))


def check_torn(folder: Path, truth: bytes) -> None:
    """A record that a crash has cut short is gone without a word, the ones before it are there."""
    result = recovered(folder)
    assert result.damages == ()
    assert len(truth) - len(told(result)) <= 2 * INPUT_BYTES
    assert truth.startswith(told(result))
    require_usable(folder, told(result))


@pytest.mark.usefixtures("fast")
@pytest.mark.parametrize("also", ["journal-000001.log", "journal-000002.log"])
def test_two_changed_files_are_told(tmp_path: Path, small: tuple[Files, bytes], also: str) -> None:
    files, truth = small
    for at in range(len(store_format._MAGIC), len(files[also])):
        damaged = files | {also: flipped(files[also], at), "snapshot-000002.state": b"bad"}
        folder = restored(tmp_path / "copy", damaged)
        result = recovered(folder)
        assert truth.startswith(told(result)) and told(result) != truth
        assert {line.split(": ")[0] for line in result.damages} >= {
            str(folder / also),
            str(folder / "snapshot-000002.state"),
        }
        require_usable(folder, told(result))


def test_a_damaged_snapshot_is_replaced_by_the_one_before_and_two_journals(
    tmp_path: Path, small: tuple[Files, bytes]
) -> None:
    files, truth = small
    folder = restored(tmp_path / "copy", files | {"snapshot-000002.state": b"bad"})
    result = recovered(folder)
    assert (result.snapshot, len(result.inputs)) == (truth[: 3 * INPUT_BYTES], 5)
    assert told(result) == truth
    assert "snapshot 1 and the inputs after it are used" in result.damages[0]


def test_damage_costs_the_inputs_from_there_on_and_says_how_much(tmp_path: Path) -> None:
    truth = filled(tmp_path, 4, snapshot_every=10)
    path = tmp_path / "journal-000000.log"
    data = path.read_bytes()
    at = data.index(b"002")
    path.write_bytes(flipped(data, at))
    result = recovered(tmp_path)
    assert told(result) == truth[: 2 * INPUT_BYTES]
    lost = len(data) - (at - 44)
    assert result.damages == (
        f"{path}: input 3, at byte {at - 44}, does not match its checksum; the 2 before it are"
        f" kept, the {lost} bytes from there on are lost; renamed to {path.name}.damaged",
    )


def test_a_journal_after_lost_inputs_is_not_used_even_later(
    tmp_path: Path, small: tuple[Files, bytes]
) -> None:
    files, truth = small
    cut = files["journal-000001.log"][:-1]
    bad = {"journal-000001.log": cut, "snapshot-000002.state": b"bad"}
    folder = restored(tmp_path / "copy", files | bad)
    result = recovered(folder)
    assert told(result) == truth[: 5 * INPUT_BYTES]
    assert "does not continue what is before it" in result.damages[2]
    with Store(folder) as store:
        store.recover()
        store.append(truth[5 * INPUT_BYTES : 6 * INPUT_BYTES])
    assert told(recovered(folder)) == truth[: 6 * INPUT_BYTES]


def test_a_journal_that_is_gone_is_told(tmp_path: Path, small: tuple[Files, bytes]) -> None:
    files, truth = small
    del files["journal-000002.log"]
    folder = restored(tmp_path / "copy", files)
    result = recovered(folder)
    assert told(result) == truth[: 6 * INPUT_BYTES]
    (line,) = result.damages
    assert "journal-000002.log: is missing" in line
    require_usable(folder, told(result))


def test_a_folder_with_nothing_good_starts_anew_and_keeps_the_files(
    tmp_path: Path, small: tuple[Files, bytes]
) -> None:
    files, _ = small
    bad = {name: b"bad" for name in files if name.startswith("snapshot")}
    folder = restored(tmp_path / "copy", files | bad)
    result = recovered(folder)
    assert (result.snapshot, result.inputs, len(result.damages)) == (None, (), 4)
    assert "nothing is left, it starts anew" in result.damages[0]
    assert {f"{name}.damaged" for name in files} <= names(folder)
    require_usable(folder, b"")


def test_another_folders_journal_is_not_taken_for_ones_own(tmp_path: Path) -> None:
    for name in ("one", "other"):
        filled(tmp_path / name, 5)
    stray = tmp_path / "other" / "journal-000001.log"
    stray.replace(tmp_path / "one" / stray.name)
    result = recovered(tmp_path / "one")
    # The same inputs, so the same digests but for the random start.
    assert told(result) == b"".join(inputs(3))
    assert "does not continue" in result.damages[0]


def test_a_tail_of_zeros_is_a_crash(tmp_path: Path, small: tuple[Files, bytes]) -> None:
    files, truth = small
    name = "journal-000002.log"
    for number in (1, 44, 4096):
        folder = restored(tmp_path / "copy", files | {name: files[name] + bytes(number)})
        assert recovered(folder).damages == ()
        require_usable(folder, truth)


def test_a_torn_input_leaves_nothing_behind_a_shorter_one(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        store.recover()
        store.append(b"long" * 100)
    path = tmp_path / "journal-000000.log"
    path.write_bytes(path.read_bytes()[:-1])
    with Store(tmp_path) as store:
        assert store.recover() == Recovered(None, (), ())
        store.append(b"short")
    assert recovered(tmp_path) == Recovered(None, (b"short",), ())


@pytest.mark.parametrize(
    ("name", "as_name"),
    [
        ("snapshot-000001.state", "snapshot-000002.state"),
        ("journal-000001.log", "journal-000002.log"),
    ],
)
def test_a_file_under_anothers_name_is_told(
    tmp_path: Path, small: tuple[Files, bytes], name: str, as_name: str
) -> None:
    files, truth = small
    folder = restored(tmp_path / "copy", files | {as_name: files[name]})
    result = recovered(folder)
    (line,) = result.damages
    assert f"{as_name}: holds generation 1, expected" in line
    assert truth.startswith(told(result))
    require_usable(folder, told(result))


def test_a_second_damaged_file_does_not_replace_the_first(tmp_path: Path) -> None:
    for content_found in (b"one", b"two", b"three"):
        (tmp_path / "snapshot-000001.state").write_bytes(content_found)
        recovered(tmp_path)
    base = "snapshot-000001.state.damaged"
    kept = [(tmp_path / name).read_bytes() for name in (base, f"{base}-2", f"{base}-3")]
    assert kept == [b"one", b"two", b"three"]


@pytest.mark.parametrize("name", ["snapshot-000001.state", "journal-000002.log"])
def test_another_version_is_refused_and_nothing_is_changed(
    tmp_path: Path, small: tuple[Files, bytes], name: str
) -> None:
    newer = b"calibgraph-tracker/2\nwhatever"
    files = small[0] | {name: newer, "snapshot-000002.state": b"bad", "lock": b""}
    folder = restored(tmp_path / "copy", files)
    message = f"{name}: is of format calibgraph-tracker/2, expected calibgraph-tracker/1; use"
    with pytest.raises(FileError, match=message):
        recovered(folder)
    assert content(folder) == files


@pytest.mark.parametrize("name", ["snapshot-000001.state", "journal-000002.log"])
@pytest.mark.parametrize("good_opens", [0, 1])
def test_a_file_that_cannot_be_read_is_told_in_one_line_and_is_no_damage(
    name: str,
    good_opens: int,
    tmp_path: Path,
    small: tuple[Files, bytes],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    files = small[0] | {"snapshot-000002.state": b"bad", "lock": b""}
    folder = restored(tmp_path / "copy", files)
    opens: list[Path] = []
    really = Path.open

    def refuse(path: Path, *args: Any, **options: Any) -> Any:
        opens.append(path)
        if path.name == name and opens.count(path) > good_opens:
            raise OSError(errno.EIO, "Input/output error", str(path))
        return really(path, *args, **options)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", refuse)
        with pytest.raises(FileError, match=f"{name}: cannot be read .*Input/output") as caught:
            recovered(folder)
    assert "\n" not in str(caught.value)
    assert content(folder) == files
    assert told(recovered(folder)) == small[1]


def test_a_failing_read_while_mending_leaves_the_journal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its third read, after that of its format and that of its records."""
    truth = filled(tmp_path, 2)
    path = tmp_path / "journal-000000.log"
    path.write_bytes(flipped(path.read_bytes(), -1))
    files, opens, really = content(tmp_path), itertools.count(), Path.open

    def refuse(path: Path, *args: Any, **options: Any) -> Any:
        if next(opens) == 2:
            raise OSError(errno.EIO, "Input/output error", str(path))
        return really(path, *args, **options)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", refuse)
        with pytest.raises(FileError, match="cannot be read"):
            recovered(tmp_path)
    assert content(tmp_path) == files
    assert told(recovered(tmp_path)) == truth[:INPUT_BYTES]


# The lock.


HOLDING = """
import sys
from pathlib import Path
from calibgraph.tracking.store import Store
store = Store(Path(sys.argv[1]))
print("locked", flush=True)
sys.stdin.read()
"""


def test_two_processes_cannot_have_one_folder(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HOLDING, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == b"locked\n"
        with pytest.raises(FileError, match="is in use by another process; stop that one"):
            Store(tmp_path)
        other.send_signal(signal.SIGKILL)
        other.wait()
    filled(tmp_path, 1)


def test_a_second_store_of_one_folder_is_refused_until_the_first_is_closed(tmp_path: Path) -> None:
    with Store(tmp_path), pytest.raises(FileError, match="is in use"):
        Store(tmp_path)
    filled(tmp_path, 1)
