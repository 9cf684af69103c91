"""The tables of the service: SQLite in the data folder, or another by its URL; that of trackers."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy import Engine, func, select
from sqlalchemy.exc import ArgumentError, NoSuchModuleError, SQLAlchemyError

from calibgraph.errors import CalibrationError
from calibgraph.service.access import Caller

DATABASE = "service.sqlite"
LAYOUT = "1"
_WAIT_S = 30.0

tables = sa.MetaData()

jobs = sa.Table(
    "jobs",
    tables,
    sa.Column("number", sa.Integer().with_variant(sa.BigInteger, "postgresql"), primary_key=True),
    sa.Column("id", sa.String(64), nullable=False, unique=True),
    sa.Column("tenant", sa.String(64), nullable=False),
    sa.Column("kind", sa.String(16), nullable=False),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("request", sa.Text, nullable=False),
    sa.Column("digest", sa.String(64), nullable=False),
    sa.Column("idempotency_key", sa.String(255)),
    sa.Column("created_s", sa.Float, nullable=False),
    sa.Column("started_s", sa.Float),
    sa.Column("finished_s", sa.Float),
    sa.Column("starts", sa.Integer, nullable=False),
    sa.Column("verdict", sa.String(16)),
    sa.Column("cannot_tell", sa.Boolean),
    sa.Column("error_kind", sa.String(16)),
    sa.Column("error", sa.Text),
    sa.Column("name", sa.String(100)),
    sa.Column("note", sa.Text),
    sa.UniqueConstraint("tenant", "idempotency_key"),
    sa.Index("jobs_by_state", "state", "tenant", "number"),
    sa.Index("jobs_by_tenant", "tenant", "number"),
)

trackers = sa.Table(
    "trackers",
    tables,
    sa.Column("number", sa.Integer().with_variant(sa.BigInteger, "postgresql"), primary_key=True),
    sa.Column("id", sa.String(64), nullable=False, unique=True),
    sa.Column("tenant", sa.String(64), nullable=False, index=True),
    sa.Column("name", sa.String(64), nullable=False),
    sa.Column("created_s", sa.Float, nullable=False),
)

about = sa.Table(
    "about",
    tables,
    sa.Column("name", sa.String(16), primary_key=True),
    sa.Column("value", sa.String(64)),
)


def open_database(folder: Path, url: str | None, owner: str) -> sa.Engine:
    """The database of a server: SQLite in its folder without a URL; it belongs to one owner.

    Raises:
        CalibrationError: if it cannot be opened, or is another server's or another layout.
    """
    where = "the database" if url else str(folder / DATABASE)
    try:
        engine = _engine(folder, url)
        if sa.inspect(engine).has_table("about") or not sa.inspect(engine).get_table_names():
            tables.create_all(engine)
            _add_columns(engine)
        _require_ours(engine, where, owner)
    except (SQLAlchemyError, ImportError, ArgumentError, NoSuchModuleError) as error:
        why = str(getattr(error, "orig", None) or error).split("\n")[0]
        raise CalibrationError(f"{where}: cannot be opened ({why}); check --database") from error
    return engine


def _add_columns(engine: sa.Engine) -> None:
    """Add the columns that a database of an earlier version has not."""
    held = {column["name"] for column in sa.inspect(engine).get_columns("jobs")}
    for column in jobs.columns:
        if column.name not in held:
            kind = column.type.compile(engine.dialect)
            with engine.begin() as connection:
                connection.execute(sa.text(f"ALTER TABLE jobs ADD COLUMN {column.name} {kind}"))


def _engine(folder: Path, url: str | None) -> sa.Engine:
    if url is not None and not url.startswith("sqlite"):
        return sa.create_engine(url, pool_pre_ping=True)
    engine = sa.create_engine(
        url or f"sqlite:///{folder / DATABASE}", connect_args={"timeout": _WAIT_S}, pool_size=20
    )

    @sa.event.listens_for(engine, "connect")
    def _prepare(connection: Any, _: object) -> None:
        cursor = connection.cursor()
        cursor.execute("PRAGMA journal_mode=WAL")
        cursor.execute("PRAGMA synchronous=FULL")  # what is acknowledged is on disk
        cursor.close()

    return engine


def _require_ours(engine: sa.Engine, where: str, owner: str) -> None:
    with engine.begin() as connection:
        found = {row.name: row.value for row in connection.execute(sa.select(about))}
        if not found:
            rows = [{"name": "layout", "value": LAYOUT}, {"name": "owner", "value": owner}]
            connection.execute(about.insert(), rows)
            return
    if found.get("layout") != LAYOUT:
        layout = found.get("layout")
        raise CalibrationError(f"{where}: has layout {layout}, expected {LAYOUT}; take another")
    if found.get("owner") != owner:
        raise CalibrationError(f"{where}: belongs to another --data folder; take another database")


@dataclass(frozen=True)
class TrackerRecord:
    """A tracker, as the table holds it."""

    id: str
    tenant: str
    name: str
    created_s: float


class TrackerTable:
    """The trackers of a server."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    def add(self, id: str, tenant: str, name: str) -> TrackerRecord:
        """Add a tracker; it is durable when this returns."""
        record = TrackerRecord(id, tenant, name, time.time())
        with self._engine.begin() as connection:
            connection.execute(trackers.insert().values(**vars(record)))
        return record

    def get(self, id: str, caller: Caller) -> TrackerRecord | None:
        """A tracker; None if there is none that the caller sees."""
        query = select(*_COLUMNS).where(trackers.c.id == id)
        with self._engine.connect() as connection:
            row = connection.execute(query).mappings().first()
        return TrackerRecord(**row) if row is not None and caller.sees(row["tenant"]) else None

    def list(self, caller: Caller) -> list[TrackerRecord]:
        """The trackers that a caller sees, the newest first."""
        query = select(*_COLUMNS).order_by(trackers.c.number.desc())
        if caller.scope != "admin":
            query = query.where(trackers.c.tenant == caller.tenant)
        with self._engine.connect() as connection:
            return [TrackerRecord(**row) for row in connection.execute(query).mappings()]

    def ids(self) -> set[str]:
        """Of all trackers."""
        with self._engine.connect() as connection:
            return set(connection.execute(select(trackers.c.id)).scalars())

    def count(self, tenant: str) -> int:
        """How many a tenant has."""
        query = select(func.count()).where(trackers.c.tenant == tenant)
        with self._engine.connect() as connection:
            return int(connection.execute(query).scalar_one())

    def remove(self, id: str) -> None:
        """Forget a tracker."""
        with self._engine.begin() as connection:
            connection.execute(trackers.delete().where(trackers.c.id == id))


_COLUMNS = (trackers.c.id, trackers.c.tenant, trackers.c.name, trackers.c.created_s)
