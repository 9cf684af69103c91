"""The table of jobs: nothing that was acknowledged is lost, whatever ends the server."""

import secrets
import time
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

from sqlalchemy import ColumnElement, Engine, RowMapping, bindparam, func, select
from sqlalchemy.exc import IntegrityError

from calibgraph.fleet.task import ErrorKind
from calibgraph.service.access import Caller
from calibgraph.service.database import jobs
from calibgraph.service.requests import Job, JobKind

JobState = Literal["queued", "running", "succeeded", "failed", "cancelled"]
FINISHED: tuple[JobState, ...] = ("succeeded", "failed", "cancelled")
MOST_STARTS = 20
"""A job during which the process or the server ended so often is not started again."""

_SHORT = [c for c in jobs.c if c.name not in ("request", "digest")]

# Statements of every job, built once: building one takes as long as running it.
_ADD = jobs.insert().returning(*_SHORT)
_BY_ID = select(*_SHORT).where(jobs.c.id == bindparam("id"))
_COUNT = select(func.count()).select_from(jobs).where(jobs.c.state == bindparam("wanted"))
_COUNT_OF_TENANT = _COUNT.where(jobs.c.tenant == bindparam("whose"))
_RUNNING = (
    select(jobs.c.tenant, func.count()).where(jobs.c.state == "running").group_by(jobs.c.tenant)
)
_WAIT_LONGEST = (
    select(jobs.c.tenant, func.min(jobs.c.number))
    .where(jobs.c.state == "queued")
    .group_by(jobs.c.tenant)
)
_START = (
    jobs.update()
    .where((jobs.c.number == bindparam("next")) & (jobs.c.state == "queued"))
    .values(state="running", started_s=bindparam("now_s"), starts=jobs.c.starts + 1)
    .returning(*_SHORT)
)


@dataclass(frozen=True)
class JobRecord:
    """A job, as the table holds it; times are seconds since 1970, None if not yet."""

    number: int
    id: str
    tenant: str
    kind: JobKind
    state: JobState
    created_s: float
    started_s: float | None
    finished_s: float | None
    starts: int
    verdict: str | None
    cannot_tell: bool | None
    error_kind: ErrorKind | None
    error: str | None
    idempotency_key: str | None = None
    name: str | None = None
    note: str | None = None

    @property
    def title(self) -> str:
        """Its name, else its kind and id."""
        return self.name or f"{self.kind} {self.id[:8]}"

    @property
    def result(self) -> str:
        """The verdict of its result, else its state."""
        return self.verdict or self.state

    @property
    def took_s(self) -> float | None:
        """How long it ran; None if it has not ended."""
        if self.started_s is None or self.finished_s is None:
            return None
        return self.finished_s - self.started_s

    @property
    def is_finished(self) -> bool:
        """Whether its state is final."""
        return self.state in FINISHED


def _record(row: RowMapping) -> JobRecord:
    return JobRecord(**{name: row[name] for name in JobRecord.__dataclass_fields__})


def new_id() -> str:
    """128 random bits."""
    return secrets.token_hex(16)


class OtherRequestError(Exception):
    """An idempotency key that was given with another request before."""


class JobTable:
    """The jobs of a server."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._last_start: dict[str, int] = {}  # of each tenant, in the order of all starts

    def add(self, id: str, tenant: str, job: Job, digest: str, *, key: str | None) -> JobRecord:
        """Add a job; it is durable when this returns. A known idempotency key returns its job."""
        values = {
            "id": id, "tenant": tenant, "kind": job.kind, "state": "queued",
            "request": job.model_dump_json(), "digest": digest, "idempotency_key": key,
            "created_s": time.time(), "starts": 0, "name": job.name, "note": job.note,
        }  # fmt: skip
        try:
            with self._engine.begin() as connection:
                return _record(connection.execute(_ADD, values).mappings().one())
        except IntegrityError:
            known = self.known(tenant, key, digest)
            if known is None:
                raise
            return known

    def known(self, tenant: str, key: str | None, digest: str | None = None) -> JobRecord | None:
        """The job that a request with an idempotency key made before."""
        if key is None:
            return None
        where = (jobs.c.tenant == tenant) & (jobs.c.idempotency_key == key)
        with self._engine.connect() as connection:
            row = connection.execute(select(jobs).where(where)).mappings().first()
        if row is not None and digest is not None and row["digest"] != digest:
            raise OtherRequestError
        return None if row is None else _record(row)

    def get(self, id: str, caller: Caller | None = None) -> JobRecord | None:
        """A job; None if there is none that the caller sees."""
        with self._engine.connect() as connection:
            row = connection.execute(_BY_ID, {"id": id}).mappings().first()
        if row is None or (caller is not None and not caller.sees(row["tenant"])):
            return None
        return _record(row)

    def request(self, id: str) -> Job:
        """What a job was asked for."""
        with self._engine.connect() as connection:
            text = connection.execute(select(jobs.c.request).where(jobs.c.id == id)).scalar_one()
        return Job.model_validate_json(text)

    def newest(self, caller: Caller, most: int, before: int | None = None) -> list[JobRecord]:
        """The newest jobs that a caller sees, before a number."""
        query = select(*_SHORT).order_by(jobs.c.number.desc()).limit(most)
        if caller.scope != "admin":
            query = query.where(jobs.c.tenant == caller.tenant)
        if before is not None:
            query = query.where(jobs.c.number < before)
        with self._engine.connect() as connection:
            return [_record(row) for row in connection.execute(query).mappings()]

    def count(self, state: JobState, tenant: str | None = None) -> int:
        """How many jobs, of all tenants or of one, are in a state."""
        query = _COUNT if tenant is None else _COUNT_OF_TENANT
        values = {"wanted": state} | ({} if tenant is None else {"whose": tenant})
        with self._engine.connect() as connection:
            return int(connection.execute(query, values).scalar_one())

    def start_next(self, most_running: int | None = None) -> JobRecord | None:
        """Take the next job; None if there is none. One thread at a time.

        Tenants take turns: first those with the fewest jobs that run, of these the one whose last
        start is the longest ago. Of a tenant the job that has waited longest is next.
        """
        while (number := self._next(most_running)) is not None:
            with self._engine.begin() as connection:
                values = {"next": number, "now_s": time.time()}
                row = connection.execute(_START, values).mappings().first()
            if row is not None:  # it was not cancelled meanwhile
                starts = max(self._last_start.values(), default=0)
                self._last_start[row["tenant"]] = starts + 1
                return _record(row)
        return None

    def _next(self, most_running: int | None) -> int | None:
        """The number of the next job."""
        with self._engine.connect() as connection:
            running = {tenant: count for tenant, count in connection.execute(_RUNNING)}
            waiting = [(tenant, number) for tenant, number in connection.execute(_WAIT_LONGEST)]
        turns = [
            (running.get(tenant, 0), self._last_start.get(tenant, 0), number)
            for tenant, number in waiting
            if most_running is None or running.get(tenant, 0) < most_running
        ]
        return min(turns)[-1] if turns else None

    def finish(
        self,
        id: str,
        state: JobState,
        *,
        verdict: str | None = None,
        cannot_tell: bool | None = None,
        error_kind: ErrorKind | None = None,
        error: str | None = None,
    ) -> bool:
        """Give a running job its final state; False if it has one."""
        values = {
            "state": state, "verdict": verdict, "cannot_tell": cannot_tell,
            "error_kind": error_kind, "error": error, "finished_s": time.time(),
        }  # fmt: skip
        return self._change(_is(id, "running"), values) > 0

    def cancel(self, id: str) -> bool:
        """Cancel a job; False if it is finished."""
        values = {"state": "cancelled", "finished_s": time.time()}
        return self._change(_is(id, "queued", "running"), values) > 0

    def put_back(self, id: str | None = None) -> int:
        """Let a running job, or all, wait again, and count them; those started too often fail."""
        which = jobs.c.state == "running" if id is None else _is(id, "running")
        text = f"its process or the server ended {MOST_STARTS} times while it ran"
        self._change(
            which & (jobs.c.starts >= MOST_STARTS),
            {"state": "failed", "error_kind": "worker died", "error": text,
             "finished_s": time.time()},
        )  # fmt: skip
        return self._change(which, {"state": "queued", "started_s": None})

    def finished_before(self, time_s: float) -> list[str]:
        """Ids of the jobs that ended before a time."""
        where = jobs.c.state.in_(FINISHED) & (jobs.c.finished_s < time_s)
        with self._engine.connect() as connection:
            return list(connection.execute(select(jobs.c.id).where(where)).scalars())

    def remove(self, ids: Iterable[str]) -> None:
        """Forget jobs."""
        with self._engine.begin() as connection:
            for id in ids:
                connection.execute(jobs.delete().where(jobs.c.id == id))

    def states(self) -> dict[str, JobState]:
        """The states of all jobs, by their ids."""
        with self._engine.connect() as connection:
            rows = connection.execute(select(jobs.c.id, jobs.c.state))
            return {id: state for id, state in rows}

    def _change(self, where: ColumnElement[bool], values: dict[str, Any]) -> int:
        with self._engine.begin() as connection:
            return connection.execute(jobs.update().where(where).values(values)).rowcount


def _is(id: str, *states: JobState) -> ColumnElement[bool]:
    return (jobs.c.id == id) & jobs.c.state.in_(states)
