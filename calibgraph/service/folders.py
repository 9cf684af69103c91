"""The server's data folder, with one per job and tracker."""

import shutil
from pathlib import Path

from calibgraph.files import require_place_for_folder, sync_to_disk

INPUT, SCRATCH, WORK, RESULT, LOG = "input", "scratch", "work", "result", "log.txt"
"""In a job's folder: its input, its working folder, its result as it is written, then; its log."""

FILES, ARCHIVE, SUMMARY = "files", "files.zip", "summary.json"
"""In the result: the files that the command writes, all of them, the summary that it prints."""


class DataFolder:
    """The data folder of a server.

    Raises:
        FileError: if it cannot be used.
    """

    def __init__(self, path: Path) -> None:
        require_place_for_folder(path)
        path.mkdir(parents=True, exist_ok=True, mode=0o700)
        self.path = path.resolve()
        self.jobs, self.trackers = self.path / "jobs", self.path / "trackers"
        self.arriving = self.path / "arriving"

    def clear(self) -> None:
        """Make the folders in it, without what was arriving when an earlier server ended."""
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
