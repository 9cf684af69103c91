"""The table of trackers: whose they are; their state is in their folders."""

import time
from dataclasses import dataclass

from sqlalchemy import Engine, func, select

from calibgraph.service.access import Caller
from calibgraph.service.database import trackers


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
