"""The server's data folder, with one per job and tracker."""

import fcntl
import os
import shutil
from pathlib import Path

from calibgraph.errors import FileError
from calibgraph.files import require_place_for_folder, sync_to_disk

INPUT, SCRATCH, WORK, RESULT, LOG = "input", "scratch", "work", "result", "log.txt"
"""In a job's folder: its input, its working folder, its result as it is written, then; its log."""

FILES, ARCHIVE, SUMMARY = "files", "files.zip", "summary.json"
"""In the result: the files that the command writes, all of them, the summary that it prints."""


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

    def of_job(self, id: str) -> Path:
        """The folder of a job."""
        return self.jobs / id

    def keep(self, arrived: Path) -> None:
        """Put an upload on disk, and give it its place among the jobs."""
        for path in (*arrived.rglob("*"), arrived):
            sync_to_disk(path)
        arrived.rename(self.of_job(arrived.name))
        sync_to_disk(self.jobs)

    def close(self) -> None:
        """Release the folder."""
        os.close(self._lock)


def _lock(folder: Path) -> int:
    try:
        descriptor = os.open(folder / "lock", os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        why = "is in use by another server; stop that one, or give another --data"
        raise FileError(folder, why) from None
    except OSError as error:
        raise FileError(folder, f"cannot be locked ({error.strerror})") from error
    return descriptor
