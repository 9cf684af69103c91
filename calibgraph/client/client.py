"""A server's calibrations from Python, in blocking calls."""

import json
import os
import tempfile
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import httpx

from calibgraph.client.inputs import Source, form_of
from calibgraph.errors import CalibrationError
from calibgraph.progress import Progress, no_progress

TOKEN_VARIABLE = "CALIBGRAPH_TOKEN"
"""In the environment: the token, if none is given."""

_TIMEOUT = httpx.Timeout(60.0, read=120.0, write=120.0)
_PATHS = {"calibration": "calibrations", "solve": "solves", "check": "checks"}
_LINES = "application/x-ndjson"


class ServerError(CalibrationError):
    """A request that the server refused, or a server that does not answer.

    Attributes:
        status: of HTTP; None without an answer.
        retry_after_s: when to try again; None if that is not known.
    """

    def __init__(
        self, message: str, status: int | None = None, retry_after_s: float | None = None
    ) -> None:
        super().__init__(message)
        self.status, self.retry_after_s = status, retry_after_s


@dataclass(frozen=True)
class RemoteJob:
    """A job of a server.

    Attributes:
        kind: calibration, solve or check.
        state: queued, running, succeeded, failed or cancelled.
        stage, done, total: how far it is, while it runs.
        verdict: of the result; None as long as there is none.
        cannot_tell: whether the data determine too little for another one; None if unknown.
        error: why it failed, in one line.
        name, note: that were given with it.
    """

    id: str
    kind: str
    state: str
    stage: str = ""
    done: int = 0
    total: int = 0
    verdict: str | None = None
    cannot_tell: bool | None = None
    error: str | None = None
    name: str = ""
    note: str = ""

    @property
    def is_finished(self) -> bool:
        """Whether its state is final."""
        return self.state not in ("queued", "running")


def job_of(answer: Mapping[str, Any]) -> RemoteJob:
    """The job in an answer."""
    progress, error = answer.get("progress") or {}, answer.get("error") or {}
    return RemoteJob(
        id=answer["id"],
        kind=answer["kind"],
        state=answer["state"],
        stage=progress.get("stage", ""),
        done=progress.get("done", 0),
        total=progress.get("total", 0),
        verdict=answer.get("verdict"),
        cannot_tell=answer.get("cannot_tell"),
        error=error.get("detail"),
        name=answer.get("name", ""),
        note=answer.get("note", ""),
    )


def require_success(job: RemoteJob) -> RemoteJob:
    """The job, if it has a result."""
    if job.state == "succeeded":
        return job
    raise CalibrationError(job.error or f"the job was {job.state}")


class Client:
    """A server of ``calibgraph serve``.

    Args:
        url: of the server.
        token: of ``calibgraph token``; the variable CALIBGRAPH_TOKEN if None.

    Several threads may share it. Every method raises :class:`ServerError` if the server refuses, or
    does not answer.
    """

    def __init__(self, url: str, token: str | None = None) -> None:
        self._url = url.rstrip("/")
        given = token or os.environ.get(TOKEN_VARIABLE)
        headers = {} if given is None else {"Authorization": f"Bearer {given}"}
        self._http = httpx.Client(base_url=self._url, headers=headers, timeout=_TIMEOUT)

    def submit(
        self,
        kind: str,
        inputs: Mapping[str, Sequence[Source]],
        settings: Mapping[str, Any] | None = None,
        *,
        name: str = "",
        note: str = "",
        key: str | None = None,
    ) -> RemoteJob:
        """Ask for a job.

        Args:
            kind: calibration, solve or check.
            inputs: paths, which are sent, or URIs, which the server reads: ``rig``,
                ``correspondences``, ``recording``.
            settings: of the kind.
            name: for people, shown with the job.
            note: likewise.
            key: a repeated request with it gives the job of the first.
        """
        texts = {"settings": json.dumps(dict(settings or {})), "name": name, "note": note}
        with form_of(inputs, texts) as fields:
            headers = {} if key is None else {"Idempotency-Key": key}
            return job_of(self._json("POST", f"/v1/{_PATHS[kind]}", files=fields, headers=headers))

    def job(self, id: str, wait_s: float = 0.0) -> RemoteJob:
        """A job; waits until it is finished, not longer than this."""
        return job_of(self._json("GET", f"/v1/jobs/{id}", params={"wait_s": wait_s}))

    def jobs(self, most: int = 50) -> list[RemoteJob]:
        """The newest jobs."""
        answer = self._json("GET", "/v1/jobs", params={"limit": most})
        return [job_of(each) for each in answer["jobs"]]

    def follow(self, id: str) -> Iterator[RemoteJob]:
        """The job now, on every change, and when it is finished."""
        with self._stream(f"/v1/jobs/{id}/events") as answer:
            for line in answer.iter_lines():
                if line.startswith("data: "):
                    yield job_of(json.loads(line.removeprefix("data: ")))

    def wait(self, id: str, progress: Progress | None = None) -> RemoteJob:
        """A job, once it has a result."""
        report = progress or no_progress
        while True:
            for job in self.follow(id):
                report(job.stage or job.state, job.done, job.total)
                if job.is_finished:
                    return require_success(job)

    def cancel(self, id: str) -> RemoteJob:
        """Cancel a job."""
        return job_of(self._json("DELETE", f"/v1/jobs/{id}"))

    def result(self, id: str) -> dict[str, Any]:
        """The result, as ``--json`` prints it."""
        found: dict[str, Any] = self._json("GET", f"/v1/jobs/{id}/result")
        return found

    def download(self, id: str, folder: Path) -> list[Path]:
        """Write the files of a result into a folder; their paths."""
        with tempfile.TemporaryFile() as file:
            with self._stream(f"/v1/jobs/{id}/files.zip") as answer:
                for chunk in answer.iter_bytes():
                    file.write(chunk)
            return unpack(file, folder)

    def create_tracker(
        self, rig: Mapping[str, Any], config: Mapping[str, Any] | None = None, name: str = "tracker"
    ) -> str:
        """Begin to track a rig, given as in a rig file; the tracker's id."""
        body = {"rig": rig, "config": config or {}, "name": name}
        return str(self._json("POST", "/v1/trackers", json=body)["id"])

    def add_frames(
        self, tracker: str, frames: Iterable[Mapping[str, Any]] | bytes, media: str = _LINES
    ) -> dict[str, Any]:
        """Take in frames: mappings as ``track`` reads them, or a body with its media type."""
        lines = () if isinstance(frames, bytes) else (f"{json.dumps(each)}\n" for each in frames)
        content = frames if isinstance(frames, bytes) else "".join(lines).encode()
        headers = {"Content-Type": media}
        path = f"/v1/trackers/{tracker}/frames"
        found: dict[str, Any] = self._json("POST", path, content=content, headers=headers)
        return found

    def tracker_state(self, tracker: str) -> dict[str, Any]:
        """The last estimate of a tracker."""
        found: dict[str, Any] = self._json("GET", f"/v1/trackers/{tracker}/state")
        return found

    def _json(self, method: str, path: str, **options: Any) -> Any:
        with self._reached():
            answer = self._http.request(method, path, **options)
        self._require_accepted(answer)
        return answer.json()

    @contextmanager
    def _stream(self, path: str) -> Iterator[httpx.Response]:
        with self._reached(), self._http.stream("GET", path) as answer:
            if answer.is_error:
                answer.read()
            self._require_accepted(answer)
            yield answer

    @contextmanager
    def _reached(self) -> Iterator[None]:
        """Turn the errors of a connection into :class:`ServerError`."""
        try:
            yield
        except httpx.HTTPError as error:
            raise ServerError(f"{self._url}: does not answer ({error})") from error

    def _require_accepted(self, answer: httpx.Response) -> None:
        """Check that the server did not refuse; its answer has been read."""
        if answer.is_success:
            return
        try:
            detail = str(answer.json()["detail"])
        except (ValueError, KeyError, TypeError):
            detail = answer.content[:200].decode(errors="replace") or "no more is known"
        retry_after = answer.headers.get("retry-after", "")
        seconds = float(retry_after) if retry_after.isdecimal() else None
        raise ServerError(f"{self._url}: {detail}", answer.status_code, seconds)

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def unpack(file: Any, folder: Path) -> list[Path]:
    """Write the files of a result's archive into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    file.seek(0)
    with zipfile.ZipFile(file) as archive:
        for name in archive.namelist():
            if Path(name).name != name:
                raise ServerError(f"the server's archive holds {name!r}, expected plain names")
        archive.extractall(folder)
        return [folder / name for name in archive.namelist()]
