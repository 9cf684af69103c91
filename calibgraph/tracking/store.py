"""A tracker's state on disk: snapshots, and journals of the inputs since, safe against any crash.

Generation ``n`` is ``snapshot-00000n.state`` and ``journal-00000n.log``, the inputs after it.
Journal 0 holds the inputs from the very start. The newest two snapshots are kept, so that the
newest can be replaced by the one before it and two journals. What the bytes mean is up to the
caller.

A new generation begins with its journal, then the snapshot is put in place, then old files are
removed. So a crash may leave a journal without its snapshot, which only lengthens the recovery,
while a snapshot without its journal is always a damage.
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import TypeVar

from calibgraph.errors import FileError
from calibgraph.files import require_place_for_folder, sync_folder, write_bytes
from calibgraph.tracking.store_format import (
    DIGEST_BYTES,
    HEAD_BYTES,
    STORE_FORMAT,
    DamageError,
    Journal,
    Snapshot,
    TornError,
    decode_journal,
    decode_snapshot,
    encode_journal_head,
    encode_record,
    encode_snapshot,
    other_format,
)

_Content = TypeVar("_Content")

_SUFFIX = {"snapshot": ".state", "journal": ".log"}
_NUMBER = "([0-9]{6,18})"  # fits the 8 bytes that a file has for it
_LEFTOVER = re.compile(r"\.writing-.*\.(state|log|mended)")
_MENDED = re.compile(rf"journal-{_NUMBER}\.log\.mended")


@dataclass(frozen=True)
class Recovered:
    """What a folder holds.

    Attributes:
        snapshot: the newest good snapshot; None if there is none yet.
        inputs: the records appended after it, in order, possibly of several journals. The last may
            be one whose ``append`` did not return: it was written, but never acknowledged.
        damages: one line for each damaged file: its path, what is wrong, what was done.
    """

    snapshot: bytes | None
    inputs: tuple[bytes, ...]
    damages: tuple[str, ...]


class Store:
    """The folder of one tracker, locked against a second process; not for several threads.

    Call ``recover`` first; then ``append`` each input before it is acknowledged, and now and then
    ``snapshot`` what they led to. A damaged file is never deleted: it is renamed to
    ``NAME.damaged``.

    Args:
        folder: where the state is kept; made if it is not there. Other files in it are left alone.

    Raises:
        FileError: if another process has the folder, or a file has its name.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        _make_folder(folder)
        self._lock: int | None = _locked(folder)
        self._tail: _Tail | None = None
        self._base = 0
        self._refuses = False

    def recover(self) -> Recovered:
        """Read the folder, set damaged files aside, and get ready to append.

        Damage costs the inputs from there on, never earlier ones, and is always told. A record cut
        short at the end of the last journal is no damage: its ``append`` never returned.

        Raises:
            FileError: if a file is of another version of the format, or cannot be read; it is
                left as it is: mend that and call this again.
            OSError: if a file cannot be written.
        """
        self._require_open()
        self._leave_journal()
        _require_version(self._folder)
        _tidy(self._folder)
        listed = {kind: _listed(self._folder, kind) for kind in _SUFFIX}
        snapshots, bad_snapshots = _read(listed["snapshot"], decode_snapshot)
        journals, bad_journals = _read(listed["journal"], decode_journal)
        base = snapshots[max(snapshots)] if snapshots else _START
        usable = _continuous(base, journals)
        damages = [
            *_mend_journals(listed, journals),
            *_drop(bad_snapshots, _instead(base, usable)),
            *_drop(bad_journals, "its inputs are lost"),
            *_drop(_unusable(listed, base, journals, usable), "they are not used"),
            *_missing_journals(self._folder, listed, base),
        ]
        self._resume(base, usable)
        inputs = tuple(record for journal in usable.values() for record in journal.records)
        return Recovered(base.state, inputs, tuple(damages))

    def append(self, record: bytes) -> None:
        """Add an input to the journal; it is durable when this returns.

        Raises:
            OSError: if it cannot be written; the earlier records are good, and unless the file
                could not be cut back to them, so is the next ``append``.
        """
        tail = self._require_writable()
        entry, digest = encode_record(record, tail.digest)
        try:
            _write_at(tail.descriptor, entry, tail.length)
            os.fsync(tail.descriptor)
            # Inside: an interrupt after this line must cut the file back to behind the record.
            self._tail = replace(tail, length=tail.length + len(entry), digest=digest)
        except BaseException:
            self._cut_back()
            raise

    def snapshot(self, state: bytes) -> None:
        """Keep ``state``, which all inputs so far led to; it is durable when this returns.

        Begins a new journal, and removes what is older than the snapshot before this one.

        Raises:
            OSError: if it cannot be written; the earlier snapshot and the inputs are good.
            FileError: if the folder may not be written to; as above.
        """
        tail = self._require_writable()
        generation = tail.generation + 1
        self._start_journal(generation, tail.digest)
        write_bytes(
            _path(self._folder, "snapshot", generation),
            encode_snapshot(generation, tail.digest, state),
        )
        previous, self._base = self._base, generation
        self._remove_before(previous)

    def close(self) -> None:
        """Give the folder free for another process; nothing is left to write."""
        self._leave_journal()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def __enter__(self) -> Store:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _require_open(self) -> None:
        if self._lock is None:
            raise ValueError(f"the store of {self._folder} is closed; make a new Store")

    def _require_writable(self) -> _Tail:
        self._require_open()
        if self._tail is None:
            raise ValueError(f"the store of {self._folder} was not read yet; call recover() first")
        if self._refuses:
            message = "an earlier write failed and could not be undone; free the disk and restart"
            raise OSError(errno.EIO, message, str(self._folder))
        return self._tail

    def _resume(self, base: Snapshot, usable: Mapping[int, Journal]) -> None:
        """Append after the last usable record from now on."""
        self._base = base.generation
        if usable:
            last = max(usable)
            self._open_journal(last, usable[last].end, usable[last].length)
        else:
            # A random start: the journal of another folder can never seem to continue this one.
            self._start_journal(base.generation, base.chain or os.urandom(DIGEST_BYTES))
        sync_folder(self._folder)
        self._refuses = False

    def _start_journal(self, generation: int, chain: bytes) -> None:
        path = _path(self._folder, "journal", generation)
        head = encode_journal_head(generation, chain)
        try:
            write_bytes(path, head)
            self._open_journal(generation, chain, len(head))
        except BaseException:
            # Whether this journal survives is unknown, so inputs could go neither there nor
            # to the one before it.
            self._refuses = path.exists()
            raise

    def _open_journal(self, generation: int, digest: bytes, length: int) -> None:
        """Go on in a journal after ``length`` good bytes; what is behind them is cut off."""
        descriptor = os.open(_path(self._folder, "journal", generation), os.O_RDWR)
        try:
            os.ftruncate(descriptor, length)
            # Records that a killed process had written but not synced are used from now on.
            os.fsync(descriptor)
        except BaseException:
            os.close(descriptor)
            raise
        self._leave_journal()
        self._tail = _Tail(generation, descriptor, length, digest)

    def _leave_journal(self) -> None:
        if self._tail is not None:
            descriptor, self._tail = self._tail.descriptor, None
            os.close(descriptor)

    def _cut_back(self) -> None:
        """Remove what a failed append may have left behind the good records."""
        assert self._tail is not None
        self._refuses = True
        with suppress(OSError):
            os.ftruncate(self._tail.descriptor, self._tail.length)
            os.fsync(self._tail.descriptor)
            self._refuses = False

    def _remove_before(self, generation: int) -> None:
        for kind in _SUFFIX:
            for number, path in _listed(self._folder, kind).items():
                if number < generation:
                    path.unlink()


@dataclass(frozen=True)
class _Tail:
    """Where the next record goes: the open journal, its good bytes and its last digest."""

    generation: int
    descriptor: int
    length: int
    digest: bytes


_Listed = Mapping[str, Mapping[int, Path]]
"""The files of each kind by generation."""

_START = Snapshot(0, None, None)
"""Where a store begins: no state, and any chain."""


# Reading what is there: nothing is changed here.


def _read(
    listed: Mapping[int, Path], decode: Callable[[bytes, int], _Content]
) -> tuple[dict[int, _Content], dict[Path, str]]:
    """What the good files hold, and what is wrong with the others."""
    good: dict[int, _Content] = {}
    faults: dict[Path, str] = {}
    for generation, path in listed.items():
        try:
            good[generation] = decode(_bytes_of(path), generation)
        except DamageError as fault:
            faults[path] = str(fault)
    return good, faults


def _continuous(base: Snapshot, journals: Mapping[int, Journal]) -> dict[int, Journal]:
    """The journals that lead on from ``base``, each beginning where the one before it ends."""
    usable: dict[int, Journal] = {}
    generation, chain = base.generation, base.chain
    while (journal := journals.get(generation)) and chain in (None, journal.start):
        usable[generation] = journal
        generation, chain = generation + 1, journal.end
    return usable


def _unusable(
    listed: _Listed,
    base: Snapshot,
    journals: Mapping[int, Journal],
    usable: Mapping[int, Journal],
) -> dict[Path, str]:
    """The journals after a loss. They must go: a later one could seem to continue them."""
    why = "does not continue what is before it, inputs in between are lost; it holds {} inputs"
    return {
        listed["journal"][generation]: why.format(len(journal.records))
        for generation, journal in journals.items()
        if generation >= base.generation and generation not in usable
    }


def _missing_journals(folder: Path, listed: _Listed, base: Snapshot) -> list[str]:
    """A line for each snapshot whose journal is gone: none is without one."""
    return [
        f"{_path(folder, 'journal', generation)}: is missing, the inputs after snapshot"
        f" {generation} are lost; went on without them"
        for generation in listed["snapshot"]
        if generation >= base.generation and generation not in listed["journal"]
    ]


def _instead(base: Snapshot, usable: Mapping[int, Journal]) -> str:
    if base is not _START:
        return f"snapshot {base.generation} and the inputs after it are used"
    return "the inputs from the start are used" if usable else "nothing is left, it starts anew"


# Setting damage aside: each of these may be cut short by a crash, and is done again.


def _mend_journals(listed: _Listed, journals: Mapping[int, Journal]) -> list[str]:
    """Replace each damaged journal by its good part; a line for each.

    A record that the newest file's end cuts short was never acknowledged: that is no damage.
    """
    newest = max((number for files in listed.values() for number in files), default=0)
    return [
        _mend(listed["journal"][generation], journal, journal.fault)
        for generation, journal in journals.items()
        if journal.fault and not (generation == newest and isinstance(journal.fault, TornError))
    ]


def _mend(path: Path, journal: Journal, fault: DamageError) -> str:
    """Set a journal aside and put its good part in its place; the line that tells so.

    The part is written first. ``_tidy`` finishes what a crash between the two renames leaves.
    """
    mended = path.with_name(f"{path.name}.mended")
    data = _bytes_of(path)
    write_bytes(mended, data[: journal.length])
    aside = _set_aside(path)
    mended.replace(path)
    good, lost = len(journal.records), len(data) - journal.length
    return (
        f"{path}: input {good + 1}, at byte {journal.length}, {fault}; the {good} before it are"
        f" kept, the {lost} bytes from there on are lost; renamed to {aside.name}"
    )


def _drop(faults: Mapping[Path, str], remark: str) -> list[str]:
    """Set files aside; a line for each."""
    return [
        f"{path}: {why}; renamed to {_set_aside(path).name}, {remark}"
        for path, why in faults.items()
    ]


def _set_aside(path: Path) -> Path:
    """Rename a file to the first free of NAME.damaged, NAME.damaged-2, ...; durable on return."""
    for number in count(1):
        aside = path.with_name(f"{path.name}.damaged" + (f"-{number}" if number > 1 else ""))
        if not os.path.lexists(aside):
            break
    path.rename(aside)
    sync_folder(path.parent)
    return aside


# The folder.


def _make_folder(folder: Path) -> None:
    require_place_for_folder(folder)
    new = [part for part in (folder, *folder.parents) if not part.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for part in reversed(new):
        sync_folder(part.parent)


def _locked(folder: Path) -> int:
    """A descriptor that holds the folder's lock until it is closed, or the process ends."""
    descriptor = os.open(folder / "lock", os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BaseException as error:
        os.close(descriptor)
        if isinstance(error, BlockingIOError):
            message = "is in use by another process; stop that one, or choose another folder"
            raise FileError(folder, message) from None
        raise
    return descriptor


def _path(folder: Path, kind: str, generation: int) -> Path:
    return folder / f"{kind}-{generation:06d}{_SUFFIX[kind]}"


def _listed(folder: Path, kind: str) -> dict[int, Path]:
    """The files of a kind by generation, the oldest first."""
    name = re.compile(f"{kind}-{_NUMBER}{re.escape(_SUFFIX[kind])}")
    matches = (name.fullmatch(path.name) for path in folder.iterdir())
    numbers = sorted(int(match[1]) for match in matches if match)
    files = {number: _path(folder, kind, number) for number in numbers}
    # A number with more zeros than are written is a foreign file's.
    return {number: path for number, path in files.items() if path.is_file()}


def _require_version(folder: Path) -> None:
    """Refuse a folder that another version has written, before anything in it is changed."""
    for kind in _SUFFIX:
        for path in _listed(folder, kind).values():
            if found := other_format(_bytes_of(path, HEAD_BYTES)):
                message = f"is of format {found}, expected {STORE_FORMAT}; use the calibgraph"
                raise FileError(path, f"{message} that wrote it, or choose another folder")


def _tidy(folder: Path) -> None:
    """Finish or take back what a crash has left halfway: half-written files, mended journals."""
    for path in sorted(folder.iterdir()):
        if _LEFTOVER.fullmatch(path.name):
            path.unlink()
        elif _MENDED.fullmatch(path.name):
            journal = path.with_suffix("")
            if journal.exists():
                path.unlink()
            else:
                path.replace(journal)


def _bytes_of(path: Path, most_bytes: int = -1) -> bytes:
    """The bytes of a file, or the first of them."""
    try:
        with path.open("rb") as file:
            return file.read(most_bytes)
    except OSError as error:
        message = f"cannot be read ({error}); it is left as it is, mend that and restart"
        raise FileError(path, message) from error


def _write_at(descriptor: int, data: bytes, offset: int) -> None:
    """Write all of ``data``: the system may take less of it at a time."""
    rest = memoryview(data)
    while rest:
        written = os.pwrite(descriptor, rest, offset)
        rest, offset = rest[written:], offset + written
