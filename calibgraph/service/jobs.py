"""The table of jobs, in SQLite: nothing that was acknowledged is lost."""

import sqlite3
import threading
import time
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from calibgraph.child_process import ErrorKind, Outcome
from calibgraph.errors import CalibrationError, FileError
from calibgraph.service.requests import Job, JobKind, JobProgress

JobState = Literal["queued", "running", "succeeded", "failed", "cancelled"]
FINISHED: tuple[JobState, ...] = ("succeeded", "failed", "cancelled")
MOST_STARTS = 5
"""A job during which the process or the server ended so often is not started again."""

DATABASE = "service.sqlite"
_ENDED = f"state IN {FINISHED}"
_SCHEMA = """
PRAGMA locking_mode = EXCLUSIVE;  -- against a second server
PRAGMA journal_mode = WAL;
PRAGMA synchronous = FULL;  -- what is acknowledged is on disk
CREATE TABLE IF NOT EXISTS calibgraph_jobs (
    number INTEGER PRIMARY KEY, id TEXT UNIQUE, kind TEXT, state TEXT, request TEXT, name TEXT,
    created_s REAL, started_s REAL, finished_s REAL, starts INTEGER, verdict TEXT,
    cannot_tell INTEGER, error_kind TEXT, error TEXT
);
CREATE INDEX IF NOT EXISTS calibgraph_jobs_by_state ON calibgraph_jobs (state, number);
"""


class JobRecord(BaseModel):
    """A job, as it is answered but for what is of the table alone.

    Attributes:
        number, request: in the table.
        created, started, finished: times (UTC); null if not yet.
        progress: of a running job.
        verdict: of the result: PASS, WARN or FAIL; of a check OK, WRONG or CANNOT TELL.
        cannot_tell: whether the data determine too little for another verdict.
        error_kind, error: why it failed: bad input, io, out of memory, timeout, worker died or
            internal error; and in one line what to do.
    """

    model_config = ConfigDict(frozen=True)

    number: Annotated[int, Field(exclude=True)]
    id: str
    kind: JobKind
    state: JobState
    request: Annotated[str, Field(exclude=True)]
    name: str
    created: Annotated[datetime, Field(validation_alias="created_s")]
    started: Annotated[datetime | None, Field(validation_alias="started_s")]
    finished: Annotated[datetime | None, Field(validation_alias="finished_s")]
    verdict: str | None
    cannot_tell: bool | None
    error_kind: ErrorKind | None
    error: str | None
    progress: JobProgress | None = None

    @property
    def is_finished(self) -> bool:
        """Whether its state is final."""
        return self.state in FINISHED


class JobTable:
    """The jobs of a server, locked against a second one.

    Args:
        folder: of the database.

    Raises:
        CalibrationError: if it cannot be opened, or another server uses it.
    """

    def __init__(self, folder: Path) -> None:
        path, self._using = folder / DATABASE, threading.Lock()
        try:
            self._connection = sqlite3.connect(
                path, timeout=0, check_same_thread=False, isolation_level=None
            )
            self._connection.row_factory = sqlite3.Row
            try:
                self._connection.executescript(_SCHEMA)
            except BaseException:
                self.close()
                raise
        except sqlite3.Error as error:
            if error.sqlite_errorcode == sqlite3.SQLITE_BUSY:
                why = "is in use by another server; stop that one, or give another --data"
                raise FileError(folder, why) from None
            raise CalibrationError(f"{path}: cannot be opened ({error}); move it away") from error

    def run(self, statement: str, **values: Any) -> list[Any]:
        """The rows of a statement; what it changes is on disk when this returns."""
        with self._using:
            return self._connection.execute(statement, values).fetchall()

    def close(self) -> None:
        """Close the database."""
        self._connection.close()

    def add(self, id: str, job: Job) -> JobRecord:
        """Add a job; it is durable when this returns."""
        (row,) = self.run(
            "INSERT INTO calibgraph_jobs (id, kind, state, request, name, created_s, starts) "
            "VALUES (:id, :kind, 'queued', :request, :name, :now, 0) RETURNING *",
            id=id, kind=job.kind, request=job.model_dump_json(), name=job.name, now=time.time(),
        )  # fmt: skip
        return JobRecord(**row)

    def get(self, id: str) -> JobRecord | None:
        """A job; None if there is none."""
        found = self._select("WHERE id = :id", id=id)
        return found[0] if found else None

    def newest(self, most: int, before: int | None = None) -> list[JobRecord]:
        """The newest jobs, before a number."""
        where = "" if before is None else "WHERE number < :before"
        return self._select(f"{where} ORDER BY number DESC LIMIT :most", most=most, before=before)

    def _select(self, where: str, **values: Any) -> list[JobRecord]:
        rows = self.run(f"SELECT * FROM calibgraph_jobs {where}", **values)
        return [JobRecord(**row) for row in rows]

    def counts(self) -> dict[JobState, int]:
        """How many jobs are in each state."""
        return dict(self.run("SELECT state, count(*) FROM calibgraph_jobs GROUP BY state"))

    def start_next(self) -> JobRecord | None:
        """Take the job that has waited longest; None if there is none."""
        rows = self.run(
            "UPDATE calibgraph_jobs SET state = 'running', started_s = :now, starts = starts + 1 "
            "WHERE number = (SELECT min(number) FROM calibgraph_jobs WHERE state = 'queued') "
            "RETURNING *", now=time.time()
        )  # fmt: skip
        return JobRecord(**rows[0]) if rows else None

    def finish(self, id: str, outcome: Outcome) -> None:
        """Give a running job its final state, unless it was cancelled."""
        verdict, cannot_tell = outcome.result or (None, None)
        self._end(
            "id = :id AND state = 'running'", id=id, verdict=verdict, cannot_tell=cannot_tell,
            state="succeeded" if outcome.error_kind is None else "failed",
            error_kind=outcome.error_kind, error=outcome.error,
        )  # fmt: skip

    def cancel(self, id: str) -> bool:
        """Cancel a job; False if it is finished."""
        return bool(self._end(f"id = :id AND NOT {_ENDED}", id=id, state="cancelled"))

    def put_back(self, id: str | None = None) -> int:
        """Let a running job, or all, wait again, and count them; those started too often fail."""
        which = "state = 'running' AND coalesce(id = :id, 1)"
        text = f"its process or the server ended {MOST_STARTS} times while it ran"
        often = f"{which} AND starts >= {MOST_STARTS}"
        self._end(often, id=id, state="failed", error_kind="worker died", error=text)
        again = f"SET state = 'queued', started_s = NULL WHERE {which} RETURNING id"
        return len(self.run(f"UPDATE calibgraph_jobs {again}", id=id))

    def _end(self, where: str, *, id: str | None, **values: Any) -> list[Any]:
        """Give jobs their final values; their ids."""
        sets = ", ".join(f"{name} = :{name}" for name in (*values, "finished_s"))
        ended = f"UPDATE calibgraph_jobs SET {sets} WHERE {where} RETURNING id"
        return self.run(ended, id=id, finished_s=time.time(), **values)

    def remove_finished(self, before_s: float) -> list[str]:
        """Forget the jobs that ended before a time; their ids."""
        ended = f"DELETE FROM calibgraph_jobs WHERE {_ENDED} AND finished_s < :before RETURNING id"
        return [id for (id,) in self.run(ended, before=before_s)]

    def states(self) -> dict[str, JobState]:
        """The states of all jobs, by their ids."""
        return dict(self.run("SELECT id, state FROM calibgraph_jobs"))
