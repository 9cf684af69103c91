"""Servers in this process, and a small problem to solve."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from calibgraph.service.app import create_app
from calibgraph.service.requests import Settings
from tests.cli.conftest import save_problem

URL = "http://localhost"
ONE_EACH = ("--jobs", "1", "--tracker-processes", "1")


@dataclass(frozen=True)
class Problem:
    """A rig and a table, as files are sent."""

    rig: bytes
    table: bytes

    @property
    def files(self) -> dict[str, bytes]:
        return {"rig": self.rig, "correspondences": self.table}


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    folder = save_problem(tmp_path_factory.mktemp("problem"))
    return Problem((folder / "rig.yaml").read_bytes(), (folder / "table.parquet").read_bytes())


Make = Callable[..., TestClient]


@pytest.fixture
def make_server(tmp_path: Path) -> Iterator[Make]:
    """Starts servers that take jobs in and, if not asked to, run none."""
    with ExitStack() as stack:

        def make(name: str = "data", **changes: Any) -> TestClient:
            none = {"jobs_at_once": 0, "tracker_processes": 1, "free_bytes": 0}
            app = create_app(Settings(data=tmp_path / name, **(none | changes)))
            client = TestClient(app, URL, raise_server_exceptions=False, follow_redirects=False)
            return stack.enter_context(client)

        yield make


@pytest.fixture(scope="session")
def working(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A server that runs jobs and trackers, in a process each."""
    data = tmp_path_factory.mktemp("working")
    settings = Settings(data=data / "data", jobs_at_once=1, tracker_processes=1, free_bytes=0)
    with TestClient(create_app(settings), URL, follow_redirects=False) as client:
        yield client


@pytest.fixture(scope="session")
def solved(working: TestClient, small: Problem) -> str:
    """Id of a job with a result, of the server ``working``."""
    id: str = working.post("/v1/jobs/solve", files=small.files).json()["id"]
    assert working.get(f"/v1/jobs/{id}", params={"wait_s": 60}).json()["state"] == "succeeded"
    return id


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


def service_folder(client: TestClient) -> Path:
    """The data folder of a server in this process."""
    app: Any = client.app
    return Path(app.state.service.path)
