"""Routes of results: the summary, the report, the files, other programs' formats."""

import io
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Query, Response
from fastapi.responses import FileResponse, StreamingResponse

from calibgraph.io.formats.export import export_calibration
from calibgraph.io.formats.names import EXPORT_FORMATS
from calibgraph.model.result_files import CALIBRATION_FILE, REPORT_FILE
from calibgraph.service.access import Reader
from calibgraph.service.problems import Problem, documented
from calibgraph.service.requests import FILES, RESULT, SUMMARY
from calibgraph.service.routes_jobs import JobId, find_job, no_such_job
from calibgraph.service.state import Service, State

router = APIRouter(prefix="/v1/jobs/{id}")

REPORT_POLICY = (
    "sandbox allow-scripts; default-src 'none'; img-src data:; "
    "style-src 'unsafe-inline'; script-src 'unsafe-inline'"
)
"""The report is one file with its own styles: it may do nothing else, and is of no origin."""

_SUFFIXES = {
    "kalibr": ".yaml", "ros1": ".txt", "ros2": ".txt", "ros2-launch": ".launch.xml",
    "tf2": ".yaml", "urdf": ".urdf", "autoware": ".yaml",
    "camera_info": ".zip", "opencv": ".yaml", "json": ".json",
}  # fmt: skip


def _result_folder(state: Service, caller: Reader, id: str) -> Path:
    """The folder of a result."""
    record = find_job(state, caller, id)
    if record.state != "succeeded":
        why = f" ({record.error})" if record.error else ""
        raise Problem(409, f"the job has no result: it is {record.state}{why}")
    folder = state.folder.of_job(id) / RESULT
    if not folder.exists():  # it has expired meanwhile
        raise no_such_job()
    return folder


@router.get(
    "/result",
    responses={**documented(404, 409, 422), 200: {"content": {"application/json": {}}}},
)
def result(id: JobId, state: State, caller: Reader) -> Response:
    """The result, as ``--json`` prints it: verdict, extrinsics, error bars, units in the keys."""
    path = _result_folder(state, caller, id) / SUMMARY
    try:
        return Response(path.read_bytes(), media_type="application/json")  # a few kilobytes
    except FileNotFoundError:
        raise no_such_job() from None


@router.get(
    "/files.zip",
    response_class=FileResponse,
    responses={**documented(404, 409, 422), 200: {"content": {"application/zip": {}}}},
)
def files(id: JobId, state: State, caller: Reader) -> Response:
    """The files that the command writes, in an archive."""
    folder = _result_folder(state, caller, id) / FILES
    paths = sorted(path for path in folder.iterdir() if path.is_file())
    held = tempfile.TemporaryFile()  # noqa: SIM115 - the answer closes it
    with zipfile.ZipFile(held, "w", zipfile.ZIP_STORED) as archive:
        for path in paths:
            archive.write(path, path.name)
    size = held.tell()
    headers = {"Content-Length": str(size), **_attachment(f"{id}.zip")}
    return StreamingResponse(_chunks(held), media_type="application/zip", headers=headers)


def _chunks(file: Any) -> Iterator[bytes]:
    with file:
        file.seek(0)
        while chunk := file.read(2**18):
            yield chunk


@router.get(
    "/report.html",
    response_class=FileResponse,
    responses={**documented(404, 409, 422), 200: {"content": {"text/html": {}}}},
)
def report(id: JobId, state: State, caller: Reader) -> Response:
    """The report of a result, or the page of a check: one page that explains it."""
    path = _result_folder(state, caller, id) / FILES / REPORT_FILE
    try:
        content = path.read_bytes()  # a few megabytes
    except FileNotFoundError:
        raise Problem(404, "no report was asked for") from None
    policy = {"Content-Security-Policy": REPORT_POLICY}
    return Response(content, media_type="text/html", headers=policy)


@router.get(
    "/exports/{format}",
    response_class=FileResponse,
    responses={**documented(404, 409, 422), 200: {"content": {"application/octet-stream": {}}}},
)
def export(
    id: JobId,
    format: str,
    state: State,
    caller: Reader,
    *,
    even_if_failed: Annotated[bool, Query()] = False,
) -> Response:
    """The calibration in the format of another program."""
    folder = _result_folder(state, caller, id) / FILES
    if format not in EXPORT_FORMATS:
        raise Problem(404, f"no such format; known are {', '.join(EXPORT_FORMATS)}")
    if not (folder / CALIBRATION_FILE).exists():
        raise Problem(404, "a check has no calibration to export")
    suffix = _SUFFIXES.get(format, ".txt")
    with tempfile.TemporaryDirectory() as temporary:
        # The format kitti has one name for its file.
        name = "calib.txt" if format == "kitti" else f"calibration{suffix}"
        written = export_calibration(
            folder, Path(temporary) / name, format, even_if_failed=even_if_failed
        )
        content = _zipped(written) if suffix == ".zip" else written[0].read_bytes()
    return Response(content, media_type="application/octet-stream", headers=_attachment(name))


def _zipped(files: Sequence[Path]) -> bytes:
    """Files of a few kilobytes as an archive."""
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w") as archive:
        for file in files:
            archive.write(file, file.name)
    return held.getvalue()


def _attachment(name: str) -> dict[str, str]:
    return {"Content-Disposition": f'attachment; filename="{name}"'}
