"""What a job's process gets and what it returns; and the names in a job's folder."""

from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from calibgraph.fleet.task import ErrorKind
from calibgraph.service.places import Root
from calibgraph.service.requests import Job

INPUT, WORK, RESULT, LOG = "input", "work", "result", "log.txt"
"""In a job's folder: its input, its result while it is written, its result, its log."""
FILES, SUMMARY = "files", "summary.json"
"""In the result: the files that the command writes, and the summary that it prints."""


@dataclass(frozen=True)
class JobTask:
    """A job for a process, with its limits; ``free_bytes`` of the disk stay free."""

    job: Job
    folder: Path
    roots: tuple[Root, ...]
    memory_bytes: int
    fetch_bytes: int
    unpacked_bytes: int
    free_bytes: int
    timeout_s: float


@dataclass(frozen=True)
class JobOutcome:
    """How a job ended: the verdict of its result, or why it failed, in one line."""

    verdict: str | None = None
    cannot_tell: bool | None = None
    error_kind: ErrorKind | None = None
    error: str | None = None


class JobProgress(BaseModel):
    """How far a running job is.

    Attributes:
        stage: what it does.
        done, total: steps of the stage.
    """

    model_config = ConfigDict(frozen=True)

    stage: str
    done: int
    total: int
