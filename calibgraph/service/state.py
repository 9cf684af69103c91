"""What the routes of a server share."""

from typing import Annotated

from fastapi import Depends, Request

from calibgraph.errors import CalibrationError
from calibgraph.service.database import TrackerTable, open_database
from calibgraph.service.folders import DataFolder, remove_folder
from calibgraph.service.jobs import JobTable
from calibgraph.service.metrics import Metrics
from calibgraph.service.places import open_roots
from calibgraph.service.problems import Problem
from calibgraph.service.room import Room
from calibgraph.service.runner import Runner
from calibgraph.service.settings import MAX_BODIES_BYTES, Settings
from calibgraph.service.trackers import Trackers

_RETRY_AFTER = {"Retry-After": "5"}


class Service:
    """The parts of a server.

    Raises:
        CalibrationError: if the data folder, the database or a root cannot be used.
    """

    def __init__(self, settings: Settings, metrics: Metrics) -> None:
        self.settings, self.metrics, self.is_stopping = settings, metrics, False
        self.roots, self.folder = open_roots(settings.roots), DataFolder(settings.data)
        try:
            engine = open_database(self.folder.path, settings.database, self.folder.owner)
        except CalibrationError:
            self.folder.close()
            raise
        self.engine, self.jobs, self.tracker_table = engine, JobTable(engine), TrackerTable(engine)
        self.runner = Runner(self.jobs, self.folder, settings, self.roots, metrics=metrics)
        self.trackers = Trackers(self.folder, settings)
        self.disk = Room(self.folder.free_bytes, settings.free_bytes, 507)
        self.memory = Room(lambda: MAX_BODIES_BYTES - self.memory.arrived_bytes, 0, 429)

    def start(self) -> None:
        """Remove what an earlier server left, and begin to run jobs, in the event loop."""
        known = self.tracker_table.ids()
        for left in self.folder.trackers.iterdir():
            if left.name not in known:  # a server was killed while it made or removed it
                remove_folder(left)
        self.runner.start()

    def begin_stop(self) -> None:
        """Accept nothing more, and let those go who wait."""
        self.is_stopping = True
        self.runner.begin_stop()

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


async def _service(request: Request) -> Service:
    service: Service = request.app.state.service
    return service


State = Annotated[Service, Depends(_service)]
"""A parameter of routes: the parts of the server."""
