"""Several files that replace older ones together."""

import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from calibgraph.errors import FileError
from calibgraph.files import cannot_write, require_place_for_folder, sync_folder

INDEX_FILES = (
    "calibration.yaml", "doctor.json", "fleet_model.json", "session.json", "state/state.sqlite"
)  # fmt: skip
"""A folder that holds one of these is a command's own, and may be written again."""
_PREFIX = ".writing-"
_NEW_S = 60.0


def require_own_folder(folder: Path, read: Iterable[Path] = ()) -> None:
    """Check, before hours of work, that a command may write its files into a folder.

    Raises:
        FileError: if there is no place for it, if it holds files and none of ``INDEX_FILES``, or if
            it is read itself.
    """
    require_place_for_folder(folder)
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    if not any((folder / name).is_file() for name in INDEX_FILES):
        raise FileError(
            folder,
            f"holds files, but no {INDEX_FILES[0]} or other index file of calibgraph; choose "
            "another folder, or empty this one",
        )
    if any(path.is_dir() and path.samefile(folder) for path in read):
        raise FileError(
            folder, "is read by this command, which would write into it; choose another --out"
        )


@contextmanager
def written_together(folder: Path, *, last: str) -> Iterator[Path]:
    """In the body, a folder for files that are moved into ``folder`` at its end.

    After an error, as of a full disk, none of them is there, and older ones are as they were. The
    file named ``last`` is moved last: if the process is killed, it is not there before the others.
    What a killed process has left is removed by the next one. Of two processes that write into one
    folder, the files of the later one are there.

    Raises:
        FileError: if there is no place for them.
        OSError: if they cannot be written; with the path where the file should be.
    """
    require_place_for_folder(folder)
    with _temporary_folder(folder) as new:
        try:
            yield new
        except OSError as error:  # of a file where it will be, not where it is written
            path = Path(str(error.filename or ""))
            if path.is_relative_to(new):
                error.filename = str(folder / path.relative_to(new))
            raise
        if folder.name.startswith(_PREFIX):  # of another set, and locked by it
            _move_all(new, folder, last)
        else:
            with _locked(folder):
                _move_all(new, folder, last)


@contextmanager
def _temporary_folder(parent: Path) -> Iterator[Path]:
    """A folder that is locked until it is removed, or its process ends."""
    try:
        parent.mkdir(parents=True, exist_ok=True)
        for left in parent.glob(f"{_PREFIX}*"):
            with suppress(OSError):  # in use, a file, or of another user
                _remove_leftover(left)
        made = tempfile.TemporaryDirectory(dir=parent, prefix=_PREFIX)
    except OSError as error:
        raise cannot_write(parent, error) from error
    with _locked(Path(made.name)), made as name:
        yield Path(name)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder; where there are no locks, no leftover is removed either."""
    lock = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield
    finally:
        os.close(lock)


def _remove_leftover(folder: Path) -> None:
    lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        age_s = time.time() - folder.stat().st_mtime
        if any(folder.iterdir()) or age_s > _NEW_S:  # a new one may not be locked yet
            shutil.rmtree(folder)
    finally:
        os.close(lock)


def _move_all(new: Path, folder: Path, last: str) -> None:
    """Move the files of one folder into another; after an error, all is as it was."""
    paths = sorted(new.iterdir(), key=lambda path: path.name == last)
    target = folder
    try:
        kept = Path(tempfile.mkdtemp(dir=new))
        for path in paths:
            target = folder / path.name
            if target.is_file():
                _keep(target, kept / path.name)
        try:
            for path in paths:
                target = folder / path.name
                path.replace(target)
            sync_folder(folder)
        except BaseException:
            for path in paths:
                _move_back(path, folder / path.name, kept / path.name)
            raise
    except OSError as error:
        raise cannot_write(target, error) from error


def _keep(path: Path, copy: Path) -> None:
    try:
        os.link(path, copy, follow_symlinks=False)
    except OSError:  # a disk without hard links, or a file of another user
        shutil.copy2(path, copy, follow_symlinks=False)


def _move_back(new: Path, target: Path, kept: Path) -> None:
    """Undo the move of a file, if it was moved."""
    if not new.exists():
        target.replace(new)
        if kept.exists():
            kept.replace(target)
