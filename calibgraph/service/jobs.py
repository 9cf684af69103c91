"""The table of jobs: nothing that was acknowledged is lost, whatever ends the server."""

import secrets
import time
from collections.abc import Iterable
from typing import Any, Literal

import sqlalchemy as sa
from sqlalchemy import func, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Mapped, mapped_column, sessionmaker

from calibgraph.fleet.task import ErrorKind
from calibgraph.service.access import Caller
from calibgraph.service.database import NUMBER, Base
from calibgraph.service.requests import Job, JobKind

JobState = Literal["queued", "running", "succeeded", "failed", "cancelled"]
FINISHED: tuple[JobState, ...] = ("succeeded", "failed", "cancelled")
MOST_STARTS = 20
"""A job during which the process or the server ended so often is not started again."""


class JobRecord(Base):
    """A job; times are seconds since 1970, None if not yet."""

    __tablename__ = "jobs"
    __table_args__ = (
        sa.UniqueConstraint("tenant", "idempotency_key"),
        sa.Index("jobs_by_state", "state", "tenant", "number"),
        sa.Index("jobs_by_tenant", "tenant", "number"),
    )

    number: Mapped[int] = mapped_column(NUMBER, primary_key=True)
    id: Mapped[str] = mapped_column(sa.String(64), unique=True)
    tenant: Mapped[str] = mapped_column(sa.String(64))
    kind: Mapped[JobKind] = mapped_column(sa.String(16))
    state: Mapped[JobState] = mapped_column(sa.String(16))
    request: Mapped[str] = mapped_column(sa.Text, deferred=True)
    digest: Mapped[str] = mapped_column(sa.String(64), deferred=True)
    idempotency_key: Mapped[str | None] = mapped_column(sa.String(255))
    created_s: Mapped[float]
    started_s: Mapped[float | None]
    finished_s: Mapped[float | None]
    starts: Mapped[int]
    verdict: Mapped[str | None] = mapped_column(sa.String(16))
    cannot_tell: Mapped[bool | None]
    error_kind: Mapped[ErrorKind | None] = mapped_column(sa.String(16))
    error: Mapped[str | None] = mapped_column(sa.Text)
    name: Mapped[str | None] = mapped_column(sa.String(100))
    note: Mapped[str | None] = mapped_column(sa.Text)

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


_BY_TENANT = select(JobRecord.tenant).group_by(JobRecord.tenant)
_RUNNING = _BY_TENANT.add_columns(func.count()).where(JobRecord.state == "running")
_WAIT_LONGEST = _BY_TENANT.add_columns(func.min(JobRecord.number)).where(
    JobRecord.state == "queued"
)


def new_id() -> str:
    """128 random bits."""
    return secrets.token_hex(16)


class OtherRequestError(Exception):
    """An idempotency key that was given with another request before."""


class JobTable:
    """The jobs of a server."""

    def __init__(self, engine: sa.Engine) -> None:
        self._engine, self._sessions = engine, sessionmaker(engine, expire_on_commit=False)
        self._last_start: dict[str, int] = {}  # of each tenant, in the order of all starts

    def add(self, id: str, tenant: str, job: Job, digest: str, *, key: str | None) -> JobRecord:
        """Add a job; it is durable when this returns. A known idempotency key returns its job."""
        record = JobRecord(
            id=id, tenant=tenant, kind=job.kind, state="queued", request=job.model_dump_json(),
            digest=digest, idempotency_key=key, created_s=time.time(), starts=0, name=job.name,
            note=job.note,
        )  # fmt: skip
        try:
            with self._sessions.begin() as session:
                session.add(record)
        except IntegrityError:
            known = self.known(tenant, key, digest)
            if known is None:
                raise
            return known
        return record

    def known(self, tenant: str, key: str | None, digest: str | None = None) -> JobRecord | None:
        """The job that a request with an idempotency key made before."""
        if key is None:
            return None
        with self._sessions() as session:
            query = select(JobRecord).filter_by(tenant=tenant, idempotency_key=key)
            found = session.scalar(query)
            if found is not None and digest is not None and found.digest != digest:
                raise OtherRequestError
        return found

    def get(self, id: str, caller: Caller | None = None) -> JobRecord | None:
        """A job; None if there is none that the caller sees."""
        with self._sessions() as session:
            found = session.scalar(select(JobRecord).filter_by(id=id))
        sees = found is None or caller is None or caller.sees(found.tenant)
        return found if sees else None

    def request(self, id: str) -> Job:
        """What a job was asked for."""
        with self._sessions() as session:
            text = session.scalars(select(JobRecord.request).filter_by(id=id)).one()
        return Job.model_validate_json(text)

    def newest(self, caller: Caller, most: int, before: int | None = None) -> list[JobRecord]:
        """The newest jobs that a caller sees, before a number."""
        query = select(JobRecord).order_by(JobRecord.number.desc()).limit(most)
        if caller.scope != "admin":
            query = query.filter_by(tenant=caller.tenant)
        if before is not None:
            query = query.where(JobRecord.number < before)
        with self._sessions() as session:
            return [*session.scalars(query)]

    def count(self, state: JobState, tenant: str | None = None) -> int:
        """How many jobs, of all tenants or of one, are in a state."""
        query = select(func.count(JobRecord.number)).where(JobRecord.state == state)
        if tenant is not None:
            query = query.where(JobRecord.tenant == tenant)
        with self._sessions() as session:
            return session.scalar(query) or 0

    def start_next(self, most_running: int | None = None) -> JobRecord | None:
        """Take the next job; None if there is none. One thread at a time.

        Tenants take turns: first those with the fewest jobs that run, of these the one whose last
        start is the longest ago. Of a tenant the job that has waited longest is next.
        """
        while (number := self._next(most_running)) is not None:
            start = (
                sa.update(JobRecord)
                .where((JobRecord.number == number) & (JobRecord.state == "queued"))
                .values(state="running", started_s=time.time(), starts=JobRecord.starts + 1)
                .returning(JobRecord)
                .execution_options(synchronize_session=False)
            )
            with self._sessions.begin() as session:
                record = session.scalar(start)
            if record is not None:  # it was not cancelled meanwhile
                starts = max(self._last_start.values(), default=0)
                self._last_start[record.tenant] = starts + 1
                return record
        return None

    def _next(self, most_running: int | None) -> int | None:
        """The number of the next job."""
        with self._engine.connect() as connection:
            running = {each: count for each, count in connection.execute(_RUNNING)}
            waiting = [(each, number) for each, number in connection.execute(_WAIT_LONGEST)]
        turns = [
            (running.get(each, 0), self._last_start.get(each, 0), number)
            for each, number in waiting
            if most_running is None or running.get(each, 0) < most_running
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
        which = JobRecord.state == "running" if id is None else _is(id, "running")
        text = f"its process or the server ended {MOST_STARTS} times while it ran"
        self._change(
            which & (JobRecord.starts >= MOST_STARTS),
            {"state": "failed", "error_kind": "worker died", "error": text,
             "finished_s": time.time()},
        )  # fmt: skip
        return self._change(which, {"state": "queued", "started_s": None})

    def finished_before(self, time_s: float) -> list[str]:
        """Ids of the jobs that ended before a time."""
        ended = JobRecord.state.in_(FINISHED) & (JobRecord.finished_s < time_s)
        with self._sessions() as session:
            return [*session.scalars(select(JobRecord.id).where(ended))]

    def remove(self, ids: Iterable[str]) -> None:
        """Forget jobs."""
        with self._sessions.begin() as session:
            for id in ids:
                session.execute(sa.delete(JobRecord).filter_by(id=id))

    def states(self) -> dict[str, JobState]:
        """The states of all jobs, by their ids."""
        with self._sessions() as session:
            return {
                id: state for id, state in session.execute(select(JobRecord.id, JobRecord.state))
            }

    def _change(self, where: sa.ColumnElement[bool], values: dict[str, Any]) -> int:
        with self._engine.begin() as connection:
            return connection.execute(sa.update(JobRecord).where(where).values(values)).rowcount


def _is(id: str, *states: JobState) -> sa.ColumnElement[bool]:
    return (JobRecord.id == id) & JobRecord.state.in_(states)
