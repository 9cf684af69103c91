"""The data folder: one server's, with a folder per job and per tracker."""

import fcntl
import os
import secrets
import shutil
from pathlib import Path

from calibgraph.errors import FileError
from calibgraph.files import require_place_for_folder, sync_folder, write_text


class DataFolder:
    """The data folder of a server, locked against a second one.

    Raises:
        FileError: if it cannot be used, or another server uses it.
    """

    def __init__(self, path: Path) -> None:
        require_place_for_folder(path)
        path.mkdir(parents=True, exist_ok=True, mode=0o700)
        self.path = path.resolve()
        self._lock = _lock(self.path)
        self.jobs, self.trackers = self.path / "jobs", self.path / "trackers"
        self.arriving = self.path / "arriving"
        shutil.rmtree(self.arriving, ignore_errors=True)
        for folder in (self.jobs, self.trackers, self.arriving):
            folder.mkdir(exist_ok=True, mode=0o700)
        self.owner = _owner(self.path / "owner")

    def of_job(self, id: str) -> Path:
        """The folder of a job."""
        return self.jobs / id

    def of_tracker(self, id: str) -> Path:
        """The folder of a tracker."""
        return self.trackers / id

    def keep(self, arrived: Path, target: Path) -> None:
        """Give an upload that is whole and on disk its place, durably."""
        arrived.rename(target)
        sync_folder(target.parent)

    def free_bytes(self) -> int:
        """Of the disk."""
        return shutil.disk_usage(self.path).free

    def close(self) -> None:
        """Release the folder."""
        os.close(self._lock)


def _lock(folder: Path) -> int:
    descriptor = os.open(folder / "lock", os.O_RDWR | os.O_CREAT, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise FileError(
            folder, "is in use by another server; stop that one, or give another --data"
        ) from None
    return descriptor


def _owner(path: Path) -> str:
    if not path.exists():
        write_text(path, secrets.token_hex(16))
    return path.read_text().strip()


def sync_tree(folder: Path) -> None:
    """Put the files of a folder, and their names, on disk."""
    for path in folder.rglob("*"):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    sync_folder(folder)


def remove_folder(folder: Path) -> None:
    """Remove a folder and all that is in it."""
    shutil.rmtree(folder, ignore_errors=True)
