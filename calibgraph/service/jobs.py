"""The table of jobs, in SQLite or another database: nothing that was acknowledged is lost."""

import time
from pathlib import Path
from typing import Any, Literal

import sqlalchemy as sa
from sqlalchemy import func, select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import DeclarativeBase, Mapped, Session, mapped_column, sessionmaker

from calibgraph.child_process import ErrorKind, Outcome
from calibgraph.errors import CalibrationError
from calibgraph.service.requests import Job, JobKind

JobState = Literal["queued", "running", "succeeded", "failed", "cancelled"]
FINISHED: tuple[JobState, ...] = ("succeeded", "failed", "cancelled")
MOST_STARTS = 5
"""A job during which the process or the server ended so often is not started again."""

DATABASE = "service.sqlite"
_WAIT_S = 30.0
_NUMBER = sa.Integer().with_variant(sa.BigInteger, "postgresql")


class Base(DeclarativeBase):
    """What all tables have in common."""


class Owner(Base):
    """Whose the database is: of one data folder."""

    __tablename__ = "calibgraph_owner"

    id: Mapped[str] = mapped_column(sa.String(64), primary_key=True)


class JobRecord(Base):
    """A job; times are seconds since 1970, None if not yet."""

    __tablename__ = "calibgraph_jobs"
    __table_args__ = (sa.Index("calibgraph_jobs_by_state", "state", "number"),)

    number: Mapped[int] = mapped_column(_NUMBER, primary_key=True)
    id: Mapped[str] = mapped_column(sa.String(64), unique=True)
    kind: Mapped[JobKind] = mapped_column(sa.String(16))
    state: Mapped[JobState] = mapped_column(sa.String(16))
    request: Mapped[str] = mapped_column(sa.Text)
    name: Mapped[str] = mapped_column(sa.Text)
    note: Mapped[str] = mapped_column(sa.Text)
    created_s: Mapped[float]
    started_s: Mapped[float | None]
    finished_s: Mapped[float | None]
    starts: Mapped[int]
    verdict: Mapped[str | None] = mapped_column(sa.String(16))
    cannot_tell: Mapped[bool | None]
    error_kind: Mapped[ErrorKind | None] = mapped_column(sa.String(16))
    error: Mapped[str | None] = mapped_column(sa.Text)

    @property
    def is_finished(self) -> bool:
        """Whether its state is final."""
        return self.state in FINISHED


def open_database(folder: Path, url: str | None, owner: str) -> sa.Engine:
    """The database of a server: SQLite in its folder without a URL; it belongs to one owner.

    Raises:
        CalibrationError: if it cannot be opened, or is another server's.
    """
    where = "the database" if url else str(folder / DATABASE)
    try:
        engine = _engine(folder, url)
        Base.metadata.create_all(engine)
        with Session(engine) as session, session.begin():
            found = session.scalar(select(Owner.id))
            if found is None:
                session.add(Owner(id=owner))
    except (SQLAlchemyError, ImportError) as error:
        why = str(getattr(error, "orig", None) or error).split("\n")[0]
        raise CalibrationError(f"{where}: cannot be opened ({why}); check --database") from error
    if found not in (None, owner):
        raise CalibrationError(f"{where}: belongs to another --data folder; take another database")
    return engine


def _engine(folder: Path, url: str | None) -> sa.Engine:
    if url is not None and not url.startswith("sqlite"):
        return sa.create_engine(url, pool_pre_ping=True)
    engine = sa.create_engine(
        url or f"sqlite:///{folder / DATABASE}", connect_args={"timeout": _WAIT_S}, pool_size=20
    )

    @sa.event.listens_for(engine, "connect")
    def _prepare(connection: Any, _: object) -> None:
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("PRAGMA synchronous=FULL")  # what is acknowledged is on disk

    return engine


class JobTable:
    """The jobs of a server."""

    def __init__(self, engine: sa.Engine) -> None:
        self._engine, self._sessions = engine, sessionmaker(engine, expire_on_commit=False)

    def add(self, id: str, job: Job) -> JobRecord:
        """Add a job; it is durable when this returns."""
        record = JobRecord(
            id=id, kind=job.kind, state="queued", request=job.model_dump_json(), name=job.name,
            note=job.note, created_s=time.time(), starts=0,
        )  # fmt: skip
        with self._sessions.begin() as session:
            session.add(record)
        return record

    def get(self, id: str) -> JobRecord | None:
        """A job; None if there is none."""
        with self._sessions() as session:
            return session.scalar(select(JobRecord).filter_by(id=id))

    def newest(self, most: int, before: int | None = None) -> list[JobRecord]:
        """The newest jobs, before a number."""
        query = select(JobRecord).order_by(JobRecord.number.desc()).limit(most)
        if before is not None:
            query = query.where(JobRecord.number < before)
        with self._sessions() as session:
            return [*session.scalars(query)]

    def counts(self) -> dict[JobState, int]:
        """How many jobs are in each state."""
        query = select(JobRecord.state, func.count()).group_by(JobRecord.state)
        with self._engine.connect() as connection:
            return {state: count for state, count in connection.execute(query)}

    def start_next(self) -> JobRecord | None:
        """Take the job that has waited longest; None if there is none. One thread at a time."""
        first = select(func.min(JobRecord.number)).where(JobRecord.state == "queued")
        start = (
            sa.update(JobRecord)
            .where((JobRecord.number == first.scalar_subquery()) & (JobRecord.state == "queued"))
            .values(state="running", started_s=time.time(), starts=JobRecord.starts + 1)
            .returning(JobRecord)
            .execution_options(synchronize_session=False)
        )
        with self._sessions.begin() as session:
            return session.scalar(start)

    def finish(self, id: str, outcome: Outcome) -> None:
        """Give a running job its final state, unless it was cancelled."""
        verdict, cannot_tell = outcome.result or (None, None)
        values = {
            "state": "succeeded" if outcome.error_kind is None else "failed",
            "verdict": verdict, "cannot_tell": cannot_tell,
            "error_kind": outcome.error_kind, "error": outcome.error, "finished_s": time.time(),
        }  # fmt: skip
        self._change(_is(id, "running"), values)

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

    def remove_finished(self, before_s: float) -> list[str]:
        """Forget the jobs that ended before a time; their ids."""
        ended = JobRecord.state.in_(FINISHED) & (JobRecord.finished_s < before_s)
        with self._engine.begin() as connection:
            return [*connection.scalars(sa.delete(JobRecord).where(ended).returning(JobRecord.id))]

    def states(self) -> dict[str, JobState]:
        """The states of all jobs, by their ids."""
        with self._engine.connect() as connection:
            query = select(JobRecord.id, JobRecord.state)
            return {id: state for id, state in connection.execute(query)}

    def _change(self, where: sa.ColumnElement[bool], values: dict[str, Any]) -> int:
        with self._engine.begin() as connection:
            return connection.execute(sa.update(JobRecord).where(where).values(values)).rowcount


def _is(id: str, *states: JobState) -> sa.ColumnElement[bool]:
    return (JobRecord.id == id) & JobRecord.state.in_(states)
