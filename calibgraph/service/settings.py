"""Settings of the service: where it keeps its data, whom it serves, and its limits."""

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from calibgraph.parallel import count_cores

MB, GB = 10**6, 10**9
Bytes = Annotated[int, Field(gt=0)]
Count = Annotated[int, Field(ge=0)]
Seconds = Annotated[float, Field(gt=0)]


class Settings(BaseModel):
    """Settings of a server.

    Attributes:
        data: folder for jobs and trackers, of one server at a time.
        database: URL of SQLAlchemy for the table of jobs; SQLite in ``data`` if None.
        tokens: file of the tokens that may call; None: anyone on this machine may.
        hosts: names by which the server is called; others are refused. Empty: without a token file
            the names of this machine for itself, else any.
        roots: URIs of the folders from which jobs may read; none by default.
        jobs_at_once: child processes for jobs.
        most_queued: jobs that wait; further ones are refused for the time being.
        job_timeout_s: longest time of a job.
        memory_bytes: that a job, or a process with trackers, may allocate.
        recording_bytes: most bytes of an upload, packed and unpacked, and of a remote recording.
        free_bytes: of the disk; with less, nothing is accepted.
        keep_s: how long the results of finished jobs are kept.
        tracker_processes: that hold the trackers; they start with the first.
        body_bytes: most bytes of a body that is no upload: frames of a tracker.
        grace_s: how long jobs may run on when the server is told to stop.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    data: Path
    database: str | None = None
    tokens: Path | None = None
    hosts: tuple[str, ...] = ()
    roots: tuple[str, ...] = ()
    jobs_at_once: Count = Field(default_factory=count_cores)
    most_queued: Count = 1000
    job_timeout_s: Seconds = 3600.0
    memory_bytes: Bytes = 8 * GB
    recording_bytes: Bytes = 20 * GB
    free_bytes: Count = 1 * GB
    keep_s: Seconds = 30 * 86400.0
    tracker_processes: Annotated[int, Field(ge=1)] = 2
    body_bytes: Bytes = 16 * MB
    grace_s: Seconds = 10.0
