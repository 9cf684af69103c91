"""A server's calibrations from Python, in coroutines."""

from __future__ import annotations

import json
import tempfile
from collections.abc import AsyncIterator, Iterable, Mapping, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, Self

import httpx

from calibgraph.client.answers import (
    RemoteJob,
    job_in_event,
    job_of,
    reached,
    require_accepted,
    require_success,
)
from calibgraph.client.client import LINES, TIMEOUT, headers_of, lines_of, path_of, unpack
from calibgraph.client.inputs import Source, form_of


class AsyncClient:
    """A server of ``calibgraph serve``; see :class:`calibgraph.client.Client`."""

    def __init__(self, url: str, token: str | None = None) -> None:
        self._url = url.rstrip("/")
        limits = httpx.Limits(max_connections=None)
        self._http = httpx.AsyncClient(
            base_url=self._url, headers=headers_of(token), timeout=TIMEOUT, limits=limits
        )

    async def submit(
        self,
        kind: str,
        inputs: Mapping[str, Sequence[Source]],
        settings: Mapping[str, Any] | None = None,
        *,
        name: str = "",
        note: str = "",
        key: str | None = None,
    ) -> RemoteJob:
        """Ask for a job."""
        texts = {"settings": json.dumps(dict(settings or {})), "name": name, "note": note}
        with form_of(inputs, texts) as fields:
            headers = {} if key is None else {"Idempotency-Key": key}
            return job_of(await self._json("POST", path_of(kind), files=fields, headers=headers))

    async def job(self, id: str, wait_s: float = 0.0) -> RemoteJob:
        """A job; waits until it is finished, not longer than this."""
        return job_of(await self._json("GET", f"/v1/jobs/{id}", params={"wait_s": wait_s}))

    async def follow(self, id: str) -> AsyncIterator[RemoteJob]:
        """The job now, on every change, and when it is finished."""
        async with self._stream(f"/v1/jobs/{id}/events") as answer:
            async for line in answer.aiter_lines():
                for job in job_in_event(line):
                    yield job

    async def wait(self, id: str) -> RemoteJob:
        """A job, once it has a result."""
        while not (job := await self.job(id, wait_s=20.0)).is_finished:
            pass
        return require_success(job)

    async def cancel(self, id: str) -> RemoteJob:
        """Cancel a job."""
        return job_of(await self._json("DELETE", f"/v1/jobs/{id}"))

    async def result(self, id: str) -> dict[str, Any]:
        """The result, as ``--json`` prints it."""
        found: dict[str, Any] = await self._json("GET", f"/v1/jobs/{id}/result")
        return found

    async def download(self, id: str, folder: Path) -> list[Path]:
        """Write the files of a result into a folder; their paths."""
        with tempfile.TemporaryFile() as file:
            async with self._stream(f"/v1/jobs/{id}/files.zip") as answer:
                async for chunk in answer.aiter_bytes():
                    file.write(chunk)
            return unpack(file, folder)

    async def create_tracker(
        self, rig: Mapping[str, Any], config: Mapping[str, Any] | None = None, name: str = "tracker"
    ) -> str:
        """Begin to track a rig, given as in a rig file; the tracker's id."""
        body = {"rig": rig, "config": config or {}, "name": name}
        return str((await self._json("POST", "/v1/trackers", json=body))["id"])

    async def add_frames(
        self, tracker: str, frames: Iterable[Mapping[str, Any]] | bytes, media: str = LINES
    ) -> dict[str, Any]:
        """Take in frames: mappings as ``track`` reads them, or a body with its media type."""
        content = frames if isinstance(frames, bytes) else lines_of(frames)
        headers = {"Content-Type": media}
        path = f"/v1/trackers/{tracker}/frames"
        found: dict[str, Any] = await self._json("POST", path, content=content, headers=headers)
        return found

    async def tracker_state(self, tracker: str) -> dict[str, Any]:
        """The last estimate of a tracker."""
        found: dict[str, Any] = await self._json("GET", f"/v1/trackers/{tracker}/state")
        return found

    async def _json(self, method: str, path: str, **options: Any) -> Any:
        with reached(self._url):
            answer = await self._http.request(method, path, **options)
        require_accepted(self._url, answer)
        return answer.json()

    @asynccontextmanager
    async def _stream(self, path: str) -> AsyncIterator[httpx.Response]:
        with reached(self._url):
            async with self._http.stream("GET", path) as answer:
                if answer.is_error:
                    await answer.aread()
                require_accepted(self._url, answer)
                yield answer

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._http.aclose()
