"""The tables of the service: SQLite in the data folder, or another database by its URL."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sqlalchemy import (
    BigInteger,
    Boolean,
    Column,
    Engine,
    Float,
    Index,
    Integer,
    MetaData,
    String,
    Table,
    Text,
    UniqueConstraint,
    create_engine,
    event,
    inspect,
    select,
    text,
)
from sqlalchemy.exc import ArgumentError, NoSuchModuleError, SQLAlchemyError

from calibgraph.errors import CalibrationError

DATABASE = "service.sqlite"
LAYOUT = "1"
_WAIT_S = 30.0

tables = MetaData()

jobs = Table(
    "jobs",
    tables,
    Column("number", Integer().with_variant(BigInteger, "postgresql"), primary_key=True),
    Column("id", String(64), nullable=False, unique=True),
    Column("tenant", String(64), nullable=False),
    Column("kind", String(16), nullable=False),
    Column("state", String(16), nullable=False),
    Column("request", Text, nullable=False),
    Column("digest", String(64), nullable=False),
    Column("idempotency_key", String(255)),
    Column("created_s", Float, nullable=False),
    Column("started_s", Float),
    Column("finished_s", Float),
    Column("starts", Integer, nullable=False),
    Column("verdict", String(16)),
    Column("cannot_tell", Boolean),
    Column("error_kind", String(16)),
    Column("error", Text),
    Column("name", String(100)),
    Column("note", Text),
    UniqueConstraint("tenant", "idempotency_key"),
    Index("jobs_by_state", "state", "tenant", "number"),
    Index("jobs_by_tenant", "tenant", "number"),
)

trackers = Table(
    "trackers",
    tables,
    Column("number", Integer().with_variant(BigInteger, "postgresql"), primary_key=True),
    Column("id", String(64), nullable=False, unique=True),
    Column("tenant", String(64), nullable=False, index=True),
    Column("name", String(64), nullable=False),
    Column("created_s", Float, nullable=False),
)

about = Table(
    "about", tables, Column("name", String(16), primary_key=True), Column("value", String(64))
)


def open_database(folder: Path, url: str | None, owner: str) -> Engine:
    """The database of a server: SQLite in its folder without a URL; it belongs to one owner.

    Raises:
        CalibrationError: if it cannot be opened, or is another server's or another layout.
    """
    where = "the database" if url else str(folder / DATABASE)
    try:
        engine = _engine(folder, url)
        if inspect(engine).has_table("about") or not inspect(engine).get_table_names():
            tables.create_all(engine)
            _add_columns(engine)
        _require_ours(engine, where, owner)
    except (SQLAlchemyError, ImportError, ArgumentError, NoSuchModuleError) as error:
        why = str(getattr(error, "orig", None) or error).split("\n")[0]
        raise CalibrationError(f"{where}: cannot be opened ({why}); check --database") from error
    return engine


def _add_columns(engine: Engine) -> None:
    """Add the columns that a database of an earlier version has not."""
    held = {column["name"] for column in inspect(engine).get_columns("jobs")}
    for column in jobs.columns:
        if column.name not in held:
            kind = column.type.compile(engine.dialect)
            with engine.begin() as connection:
                connection.execute(text(f"ALTER TABLE jobs ADD COLUMN {column.name} {kind}"))


def _engine(folder: Path, url: str | None) -> Engine:
    if url is not None and not url.startswith("sqlite"):
        return create_engine(url, pool_pre_ping=True)
    engine = create_engine(
        url or f"sqlite:///{folder / DATABASE}", connect_args={"timeout": _WAIT_S}, pool_size=20
    )

    @event.listens_for(engine, "connect")
    def _prepare(connection: Any, _: object) -> None:
        cursor = connection.cursor()
        cursor.execute("PRAGMA journal_mode=WAL")
        cursor.execute("PRAGMA synchronous=FULL")  # what is acknowledged is on disk
        cursor.close()

    return engine


def _require_ours(engine: Engine, where: str, owner: str) -> None:
    with engine.begin() as connection:
        found = {row.name: row.value for row in connection.execute(select(about))}
        if not found:
            rows = [{"name": "layout", "value": LAYOUT}, {"name": "owner", "value": owner}]
            connection.execute(about.insert(), rows)
            return
    if found.get("layout") != LAYOUT:
        layout = found.get("layout")
        raise CalibrationError(f"{where}: has layout {layout}, expected {LAYOUT}; take another")
    if found.get("owner") != owner:
        raise CalibrationError(f"{where}: belongs to another --data folder; take another database")
