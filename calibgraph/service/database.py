"""The tables of the service: SQLite in the data folder, or another by its URL; that of trackers."""

import time
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy import Engine, select
from sqlalchemy.exc import ArgumentError, NoSuchModuleError, SQLAlchemyError
from sqlalchemy.orm import DeclarativeBase, Mapped, Session, mapped_column, sessionmaker

from calibgraph.errors import CalibrationError
from calibgraph.service.access import Caller

DATABASE = "service.sqlite"
LAYOUT = "1"
_WAIT_S = 30.0

NUMBER = sa.Integer().with_variant(sa.BigInteger, "postgresql")


class Base(DeclarativeBase):
    """What all tables have in common."""


class About(Base):
    """What a database is: its layout, and whose."""

    __tablename__ = "about"

    name: Mapped[str] = mapped_column(sa.String(16), primary_key=True)
    value: Mapped[str | None] = mapped_column(sa.String(64))


class TrackerRecord(Base):
    """A tracker."""

    __tablename__ = "trackers"

    number: Mapped[int] = mapped_column(NUMBER, primary_key=True)
    id: Mapped[str] = mapped_column(sa.String(64), unique=True)
    tenant: Mapped[str] = mapped_column(sa.String(64), index=True)
    name: Mapped[str] = mapped_column(sa.String(64))
    created_s: Mapped[float]


def open_database(folder: Path, url: str | None, owner: str) -> sa.Engine:
    """The database of a server: SQLite in its folder without a URL; it belongs to one owner.

    Raises:
        CalibrationError: if it cannot be opened, or is another server's or another layout.
    """
    where = "the database" if url else str(folder / DATABASE)
    try:
        engine = _engine(folder, url)
        if sa.inspect(engine).has_table("about") or not sa.inspect(engine).get_table_names():
            Base.metadata.create_all(engine)
            _add_columns(engine)
        _require_ours(engine, where, owner)
    except (SQLAlchemyError, ImportError, ArgumentError, NoSuchModuleError) as error:
        why = str(getattr(error, "orig", None) or error).split("\n")[0]
        raise CalibrationError(f"{where}: cannot be opened ({why}); check --database") from error
    return engine


def _add_columns(engine: sa.Engine) -> None:
    """Add the columns that a database of an earlier version has not."""
    for table in Base.metadata.sorted_tables:
        held = {column["name"] for column in sa.inspect(engine).get_columns(table.name)}
        for column in table.columns:
            if column.name not in held:
                added = f"{column.name} {column.type.compile(engine.dialect)}"
                with engine.begin() as connection:
                    connection.execute(sa.text(f"ALTER TABLE {table.name} ADD COLUMN {added}"))


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
    with Session(engine) as session, session.begin():
        found = {row.name: row.value for row in session.scalars(select(About))}
        if not found:
            session.add_all([About(name="layout", value=LAYOUT), About(name="owner", value=owner)])
            return
    if found.get("layout") != LAYOUT:
        layout = found.get("layout")
        raise CalibrationError(f"{where}: has layout {layout}, expected {LAYOUT}; take another")
    if found.get("owner") != owner:
        raise CalibrationError(f"{where}: belongs to another --data folder; take another database")


class TrackerTable:
    """The trackers of a server, which alone changes them: what is read is in memory."""

    def __init__(self, engine: Engine) -> None:
        self._sessions = sessionmaker(engine, expire_on_commit=False)
        with self._sessions() as session:
            query = select(TrackerRecord).order_by(TrackerRecord.number)
            self._records = {record.id: record for record in session.scalars(query)}

    def add(self, id: str, tenant: str, name: str) -> TrackerRecord:
        """Add a tracker; it is durable when this returns."""
        record = TrackerRecord(id=id, tenant=tenant, name=name, created_s=time.time())
        with self._sessions.begin() as session:
            session.add(record)
        self._records[id] = record
        return record

    def get(self, id: str, caller: Caller) -> TrackerRecord | None:
        """A tracker; None if there is none that the caller sees."""
        found = self._records.get(id)
        return found if found is not None and caller.sees(found.tenant) else None

    def list(self, caller: Caller) -> list[TrackerRecord]:
        """The trackers that a caller sees, the newest first."""
        every = [*self._records.values()]
        return [
            one for one in every[::-1] if caller.scope == "admin" or caller.tenant == one.tenant
        ]

    def ids(self) -> set[str]:
        """Of all trackers."""
        return {*self._records}

    def count(self, tenant: str) -> int:
        """How many a tenant has."""
        return sum(one.tenant == tenant for one in [*self._records.values()])

    def remove(self, id: str) -> None:
        """Forget a tracker."""
        with self._sessions.begin() as session:
            session.execute(sa.delete(TrackerRecord).filter_by(id=id))
        self._records.pop(id, None)
