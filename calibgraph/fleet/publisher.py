"""Outcomes to rows, and rows and logs to where they are kept."""

import hashlib
import re
import time
from collections.abc import Iterator
from typing import Any

import pyarrow as pa

from calibgraph.errors import CalibrationError
from calibgraph.fleet.execute import versions_text
from calibgraph.fleet.manifest import Job
from calibgraph.fleet.rows import SCHEMA, RowStore
from calibgraph.fleet.task import Outcome

_WAIT_S = 5.0
"""Rows wait this long for others of their bucket; so much work a command that is killed may lose.
"""


class Publisher:
    """Publishes outcomes, some at a time."""

    def __init__(self, store: RowStore, others: pa.Table, *, logs: bool) -> None:
        self._store, self._others, self._logs = store, others, logs
        self._rows: list[dict[str, Any]] = []
        self._manifest_rows: list[int] = []
        self._published_s = time.monotonic()
        self.failed = 0

    def add(self, job: Job, input_hash: str, outcome: Outcome) -> None:
        """Take an outcome; its log is kept at once."""
        self.failed += outcome.error_kind is not None
        for row in _rows_of(job, input_hash, outcome):
            self._rows.append(row)
            self._manifest_rows.append(job.row)
        if self._logs:
            self._store.put(f"_logs/{_log_name(job)}", _log_text(job, outcome).encode())

    def publish_when_due(self) -> None:
        """Publish what has waited long enough."""
        if time.monotonic() - self._published_s > _WAIT_S:
            self.publish()

    def publish(self) -> None:
        """Publish all."""
        if self._rows:
            table = pa.Table.from_pylist(self._rows, schema=SCHEMA)
            others = self._others.take(pa.array(self._manifest_rows))
            for name in others.column_names:
                table = table.append_column(others.schema.field(name), others[name])
            self._store.publish(table)
        self._rows, self._manifest_rows = [], []
        self._published_s = time.monotonic()


def _rows_of(job: Job, input_hash: str, outcome: Outcome) -> Iterator[dict[str, Any]]:
    common = {
        "vehicle": job.vehicle,
        "recording": job.recording,
        "seconds": outcome.seconds,
        "input_hash": input_hash,
        "versions": outcome.versions or versions_text(),
    }
    if outcome.error_kind is not None:
        failure = {"error_kind": outcome.error_kind, "error": outcome.error}
        yield {**common, "camera": "", "status": "failed", **failure}
    for camera in outcome.cameras:
        yield {**common, "status": "done", **vars(camera)}


def _log_name(job: Job) -> str:
    """A name of a file: vehicles may be called anything."""
    number = hashlib.sha256("\n".join(job.key).encode()).hexdigest()[:8]
    return f"{re.sub(r'[^A-Za-z0-9_.-]+', '_', job.vehicle)[:100]}-{number}.log"


def _log_text(job: Job, outcome: Outcome) -> str:
    end = "done" if outcome.error_kind is None else f"{outcome.error_kind}: {outcome.error}"
    end = str(CalibrationError(end))  # in one line
    return f"{job.vehicle}: {job.recording}\n{outcome.log}{outcome.seconds:8.1f} s  {end}\n"
