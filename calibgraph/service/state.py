"""What the routes of a server share."""

from dataclasses import dataclass, field
from typing import Annotated

from fastapi import Depends, Request
from sqlalchemy import Engine

from calibgraph.errors import CalibrationError
from calibgraph.service.database import TrackerTable, open_database
from calibgraph.service.folders import DataFolder, remove_folder
from calibgraph.service.job_events import JobEvents
from calibgraph.service.jobs import JobTable
from calibgraph.service.metrics import Metrics
from calibgraph.service.places import Root, open_roots
from calibgraph.service.problems import Problem
from calibgraph.service.room import Room
from calibgraph.service.runner import Runner
from calibgraph.service.settings import MAX_BODIES_BYTES, Settings
from calibgraph.service.trackers import Trackers

_RETRY_AFTER = {"Retry-After": "5"}


@dataclass
class Service:
    """The parts of a server."""

    settings: Settings
    folder: DataFolder
    engine: Engine
    jobs: JobTable
    runner: Runner
    tracker_table: TrackerTable
    trackers: Trackers
    roots: tuple[Root, ...]
    metrics: Metrics
    events: JobEvents
    disk: Room = field(init=False)
    memory: Room = field(init=False)
    is_stopping: bool = field(default=False)

    def __post_init__(self) -> None:
        self.disk = Room(self.folder.free_bytes, self.settings.free_bytes, 507)
        self.memory = Room(lambda: MAX_BODIES_BYTES - self.memory.arrived_bytes, 0, 429)

    def start(self) -> None:
        """Remove what an earlier server left, and begin to run jobs, in the event loop."""
        known = self.tracker_table.ids()
        for left in self.folder.trackers.iterdir():
            if left.name not in known:  # a server was killed while it made or removed it
                remove_folder(left)
        self.events.open()
        self.runner.start()

    def begin_stop(self) -> None:
        """Accept nothing more, and let those go who wait."""
        self.is_stopping = True
        self.runner.begin_stop()
        self.events.notify()

    def stop(self) -> None:
        """End the jobs and trackers, and release the data folder."""
        self.begin_stop()
        self.runner.stop(self.settings.grace_s)
        self.trackers.close()
        self.engine.dispose()
        self.folder.close()

    def require_room(self) -> None:
        """Check that something new can be taken in.

        Raises:
            Problem: if the server stops, its disk is full, or its queue is.
        """
        if self.is_stopping:
            raise Problem(503, "the server is being stopped; try again soon", _RETRY_AFTER)
        if self.folder.free_bytes() < self.settings.free_bytes:
            raise Problem(507, "the server's disk is almost full; try again later")


def open_service(settings: Settings, metrics: Metrics) -> Service:
    """The parts of a server with these settings.

    Raises:
        CalibrationError: if the data folder, the database or a root cannot be used.
    """
    roots = open_roots(settings.roots)
    folder = DataFolder(settings.data)
    try:
        engine = open_database(folder.path, settings.database, folder.owner)
    except CalibrationError:
        folder.close()
        raise
    table, events = JobTable(engine), JobEvents()
    return Service(
        settings=settings,
        folder=folder,
        engine=engine,
        jobs=table,
        runner=Runner(table, folder, settings, roots, metrics=metrics, notify=events.notify),
        tracker_table=TrackerTable(engine),
        trackers=Trackers(folder, settings),
        roots=roots,
        metrics=metrics,
        events=events,
    )


def _service_of(request: Request) -> Service:
    service: Service = request.app.state.service
    return service


async def _service(request: Request) -> Service:
    return _service_of(request)


State = Annotated[Service, Depends(_service)]
"""A parameter of routes: the parts of the server."""
