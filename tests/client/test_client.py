"""The client beside a server that answers what these tests write down."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from calibgraph.client import Client, ServerError

JOB = {"id": "7", "kind": "solve", "state": "succeeded", "verdict": "PASS", "cannot_tell": False}
RUNNING = {**JOB, "state": "running", "progress": {"stage": "solving", "done": 1, "total": 2}}


class Answers(BaseHTTPRequestHandler):
    """A job that is known by its events, and refusals of all else."""

    def do_GET(self) -> None:
        if self.path.endswith("/events"):
            lines = [f"event: x\ndata: {json.dumps(job)}\n\n" for job in (RUNNING, JOB)]
            self._send(200, "text/event-stream", ": still here\n\n" + "".join(lines))
        elif self.path == "/v1/jobs/busy/result":
            self._send(429, "application/problem+json", '{"detail": "try again"}', "3")
        else:
            self._send(500, "text/html", "<p>of a proxy")

    def _send(self, status: int, media: str, text: str, retry_after: str = "") -> None:
        self.send_response(status)
        self.send_header("Content-Type", media)
        self.send_header("Content-Length", str(len(text)))
        if retry_after:
            self.send_header("Retry-After", retry_after)
        self.end_headers()
        self.wfile.write(text.encode())

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing."""


@pytest.fixture
def client() -> Iterator[Client]:
    with ThreadingHTTPServer(("127.0.0.1", 0), Answers) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        with Client(f"http://127.0.0.1:{server.server_port}") as made:
            yield made
        server.shutdown()
        thread.join()


def test_a_job_is_waited_for_with_its_progress(client: Client) -> None:
    seen: list[tuple[str, int, int]] = []
    job = client.wait("7", lambda *step: seen.append(step))
    assert (job.verdict, job.is_finished) == ("PASS", True)
    assert seen == [("solving", 1, 2), ("succeeded", 0, 0)]


def test_coroutines_wait_for_many_jobs_of_one_client_in_threads(client: Client) -> None:
    async def wait_for_all() -> list[str]:
        jobs = await asyncio.gather(*(asyncio.to_thread(client.wait, "7") for _ in range(20)))
        return [job.state for job in jobs]

    assert asyncio.run(wait_for_all()) == ["succeeded"] * 20


def test_a_refusal_is_the_line_of_the_server_with_the_time_to_wait(client: Client) -> None:
    with pytest.raises(ServerError, match="try again") as refused:
        client.result("busy")
    assert (refused.value.status, refused.value.retry_after_s) == (429, 3.0)
    with pytest.raises(ServerError, match="<p>of a proxy") as broken:
        client.result("7")
    assert (broken.value.status, broken.value.retry_after_s) == (500, None)


def test_a_server_that_is_not_there_is_named() -> None:
    refused = pytest.raises(ServerError, match=r"http://127\.0\.0\.1:1: does not answer")
    with Client("http://127.0.0.1:1") as client, refused:
        client.jobs()
