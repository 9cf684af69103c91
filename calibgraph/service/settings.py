"""Settings of the service: where it keeps its data, whom it serves, and its limits."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from calibgraph.parallel import count_cores

MB, GB = 10**6, 10**9
Bytes = Annotated[int, Field(gt=0)]
Count = Annotated[int, Field(ge=0)]
Seconds = Annotated[float, Field(gt=0)]
Docs = Literal["token", "open", "off"]
DOCS: tuple[Docs, ...] = ("token", "open", "off")

MAX_JSON_BYTES = 8 * MB
"""Of a request's body that is JSON."""

MAX_BODIES_BYTES = 512 * MB
"""Of bodies that arrive at the same time and are kept in memory."""


class Settings(BaseModel):
    """Settings of a server.

    Attributes:
        data: folder for jobs and trackers, of one server at a time.
        database: URL of SQLAlchemy for the table of jobs; SQLite in ``data`` if None.
        tokens: file of the tokens that may call; None: anyone on this machine may.
        hosts: names by which the server is called; others are refused. Empty: without a token file
            the names of this machine for itself, else any.
        api_docs: who may read the description of the API, /docs and /openapi.json: whoever has a
            token, anyone, or no one.
        roots: URIs of the folders from which jobs may read; none by default.
        jobs_at_once: child processes for jobs.
        jobs_per_tenant: of one tenant at the same time; None: all but one if there are several
            tenants.
        most_queued: jobs of a tenant that wait; further ones are refused for the time being.
        job_timeout_s: longest time of a job.
        job_memory_bytes: that a job may allocate.
        upload_bytes: most bytes of an upload; of an archive, unpacked too.
        fetch_bytes: most bytes of a remote recording.
        free_bytes: of the disk; with less, nothing is accepted.
        keep_s: how long the results of finished jobs are kept.
        tracker_processes: that hold the trackers; 0 for no trackers.
        tracker_memory_bytes: that a process with trackers may allocate.
        frames_bytes: most bytes of one request with frames.
        grace_s: how long jobs may run on when the server is told to stop.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    data: Path
    database: str | None = None
    tokens: Path | None = None
    hosts: tuple[str, ...] = ()
    api_docs: Docs = "token"
    roots: tuple[str, ...] = ()
    jobs_at_once: Count = Field(default_factory=count_cores)
    jobs_per_tenant: Annotated[int, Field(ge=1)] | None = None
    most_queued: Count = 1000
    job_timeout_s: Seconds = 3600.0
    job_memory_bytes: Bytes = 8 * GB
    upload_bytes: Bytes = 20 * GB
    fetch_bytes: Bytes = 50 * GB
    free_bytes: Count = 1 * GB
    keep_s: Seconds = 30 * 86400.0
    tracker_processes: Count = 2
    most_trackers: Count = 200
    tracker_memory_bytes: Bytes = 8 * GB
    frames_bytes: Bytes = 16 * MB
    grace_s: Seconds = 10.0
