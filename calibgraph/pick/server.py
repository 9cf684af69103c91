"""A dataset and its session: what the page shows, and what it writes; and the server of the page.

The server answers this machine alone, at an address that nobody else knows.
"""

from __future__ import annotations

import json
import secrets
import threading
from functools import lru_cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError, DatasetError
from calibgraph.io.dataset import Dataset
from calibgraph.io.frame import Frame
from calibgraph.io.rigs import REFERENCE_FILE
from calibgraph.matching.structure.directions import find_in_view, find_visible
from calibgraph.model.geometry import degrees_and_centimetres, move_points
from calibgraph.model.rig import Camera
from calibgraph.pick.estimate import (
    SESSION_FILE,
    CameraEstimate,
    Pair,
    estimate_from_pairs,
    open_session,
    reference_rig,
    to_table,
)

TABLE_FILE = "picked.parquet"
_KEPT = 8  # clouds and images in memory
_JPEG_QUALITY = 95
_HIDDEN_SPACINGS = 1.5  # side of a cell in which near points hide far ones


class Workspace:
    """A session of picking.

    Raises:
        FileError: if the folder holds a session of another dataset.
    """

    def __init__(self, dataset: Dataset, folder: Path) -> None:
        self.dataset, self.folder = dataset, folder
        self._frames = {frame.index: frame for frame in dataset.frames}
        names = [frame.name for frame in dataset.frames]
        self.session = open_session(folder / SESSION_FILE, names, [*dataset.rig.cameras])
        self._estimate = estimate_from_pairs(dataset.rig, self.session.pairs)
        self._lock = threading.Lock()
        self.cloud = lru_cache(_KEPT)(self._cloud)
        self.image = lru_cache(_KEPT)(self._image)

    def state(self) -> dict[str, Any]:
        """Cameras, frames, pairs and what they determine, as plain values."""
        rig, (solved, cameras) = self.dataset.rig, self._estimate
        return {
            "cameras": {
                name: {"T_camera_lidar": camera.T_camera_lidar.tolist(),
                       "width_px": camera.width_px,
                       "height_px": camera.height_px}
                for name, camera in rig.cameras.items()
            },
            "frames": [{"index": frame.index, "name": frame.name, "cameras": [*frame.image_paths]}
                       for frame in self.dataset.frames],
            "pairs": [pair.model_dump() for pair in self.session.pairs],
            "estimates": {name: _answer(one, solved.cameras.get(name) if solved else None)
                          for name, one in cameras.items()},
        }  # fmt: skip

    def change(self, pairs: list[Pair]) -> dict[str, Any]:
        """Replace all pairs, save them, and return the new state.

        Raises:
            DatasetError: if a pair is of a frame or camera that the dataset does not have.
        """
        for pair in pairs:
            self._frame(pair.frame, pair.camera)
        with self._lock:
            session = self.session.model_copy(update={"pairs": tuple(pairs)})
            estimate = estimate_from_pairs(self.dataset.rig, pairs)
            session.save(self.folder / SESSION_FILE)
            self.session, self._estimate = session, estimate
            return self.state()

    def write(self) -> list[Path]:
        """Write the pairs as a table, and the reference with its error bars."""
        rig = reference_rig(self._estimate)
        table, reference = self.folder / TABLE_FILE, self.folder / REFERENCE_FILE
        to_table(self.session.pairs).save(table)
        rig.save(reference)
        return [table, reference]

    def projected(self, index: int, name: str) -> NDArray[np.float32]:
        """(k, 3) pixels and distances of the points that a camera sees, at the estimate."""
        points = self.cloud(index)[:, :3].astype(np.float64)
        return visible_points(points, (self._estimate[0] or self.dataset.rig).cameras.get(
            name, self.dataset.rig.cameras[name]))  # fmt: skip

    def _frame(self, index: int, name: str) -> Frame:
        frame = self._frames.get(index)
        if frame is None or name not in frame.image_paths:
            raise DatasetError(f"the dataset has no image of camera {name!r} in frame {index}")
        return frame

    def _cloud(self, index: int) -> NDArray[np.float32]:
        """(n, 4) finite points and their intensity, NaN if there is none."""
        if index not in self._frames:
            raise DatasetError(f"the dataset has no frame {index}")
        cloud = self._frames[index].load_cloud()
        intensity = cloud[:, 3:4] if cloud.shape[1] > 3 else np.full((len(cloud), 1), np.nan)  # noqa: PLR2004
        full = np.asarray(np.hstack([cloud[:, :3], intensity]), np.float32)
        return np.asarray(full[np.isfinite(full[:, :3]).all(axis=1)])

    def _image(self, index: int, name: str) -> bytes:
        """The image as a JPEG."""
        image = self._frame(index, name).load_image(name, self.dataset.rig.cameras[name])
        _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        return data.tobytes()


def visible_points(points_lidar_m: Array, camera: Camera) -> NDArray[np.float32]:
    """(k, 3) column, row and distance of the points that no much nearer point hides."""
    rows, angles, distance_m = find_in_view(points_lidar_m, camera)
    area = float(np.prod(np.maximum(np.ptp(angles, axis=0), 1e-6))) if len(rows) > 1 else 1.0
    cell_rad = _HIDDEN_SPACINGS * float(np.sqrt(area / max(len(rows), 1)))
    seen = find_visible(angles, distance_m, cell_rad)
    shown = move_points(points_lidar_m[rows[seen]], camera.T_camera_lidar)
    pixels, _ = camera.lens.project(shown)
    return np.column_stack([pixels, distance_m[seen]]).astype(np.float32)


def _answer(one: CameraEstimate, solved: Camera | None) -> dict[str, Any]:
    """What the page shows of a camera."""
    bars = None if solved is None or solved.covariance is None else degrees_and_centimetres(
        np.asarray(solved.covariance))  # fmt: skip
    return {
        "problem": one.problem,
        "sigma_deg": None if bars is None else bars[0].tolist(),
        "sigma_cm": None if bars is None else bars[1].tolist(),
        "residuals_px": [row if np.isfinite(row).all() else None
                         for row in one.residuals_px.tolist()],
        "wrong": one.wrong,
    }  # fmt: skip


MAX_BODY_BYTES = 2**20
_PAGE = {
    "": ("index.html", "text/html; charset=utf-8"),
    "pick.css": ("pick.css", "text/css"),
    **{name: (name, "text/javascript") for name in ("main.js", "view.js", "panorama.js")},
}
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:",
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
_PAIRS = TypeAdapter(list[Pair])


class PickServer(ThreadingHTTPServer):
    """Serves a session on the loopback interface.

    Args:
        workspace: the session.
        port: 0 for any that is free.
    """

    daemon_threads = True

    def __init__(self, workspace: Workspace, port: int) -> None:
        super().__init__(("127.0.0.1", port), _Handler)
        self.workspace, self.key = workspace, secrets.token_urlsafe(16)

    @property
    def url(self) -> str:
        """Of the page; its key keeps other programs and pages out."""
        return f"http://127.0.0.1:{self.server_port}/{self.key}/"


class _Handler(BaseHTTPRequestHandler):
    server: PickServer
    timeout = 60.0

    def do_GET(self) -> None:
        """The page, data of the session, or a change of it."""
        parts = self.path.split("?")[0].split("/")
        host, origin = f"127.0.0.1:{self.server.server_port}", self.headers.get("Origin")
        if self.headers.get("Host") != host or origin not in (None, f"http://{host}"):
            return self._send(403, b"not from here", "text/plain")
        if len(parts) < 3 or not secrets.compare_digest(parts[1], self.server.key):  # noqa: PLR2004
            return self._send(404, b"no such page", "text/plain")
        try:
            return self._send(200, *self._answer([unquote(part) for part in parts[2:]]))
        except (CalibrationError, ValidationError, ValueError, LookupError) as error:
            status, line = 400, str(error).partition("\n")[0]
        except OSError as error:
            status, line = 500, str(error)
        return self._send(status, *_json({"error": line}))

    do_POST = do_GET

    def _answer(self, parts: list[str]) -> tuple[bytes, str]:
        workspace, length = self.server.workspace, int(self.headers.get("Content-Length", "0"))
        if not 0 <= length <= MAX_BODY_BYTES:
            raise ValueError(f"a body of at most {MAX_BODY_BYTES} bytes is expected")
        body = self.rfile.read(length)
        match self.command, *parts:
            case "GET", "session":
                content = workspace.state()
            case "POST", "pairs":
                content = workspace.change(_PAIRS.validate_json(body))
            case "POST", "write":
                content = {"files": [str(path) for path in workspace.write()]}
            case "GET", "cloud", frame:
                return workspace.cloud(int(frame)).tobytes(), "application/octet-stream"
            case "GET", "projected", frame, camera:
                points = workspace.projected(int(frame), camera)
                return points.tobytes(), "application/octet-stream"
            case "GET", "image", frame, camera:
                return workspace.image(int(frame), camera), "image/jpeg"
            case "GET", name if name in _PAGE:
                file, kind = _PAGE[name]
                return files("calibgraph.pick").joinpath("page", file).read_bytes(), kind
            case _:
                raise LookupError("no such page")
        return _json(content)

    def _send(self, status: int, body: bytes, kind: str) -> None:
        self.send_response(status)
        headers = {**_HEADERS, "Content-Type": kind, "Content-Length": str(len(body))}
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Requests are not printed."""


def _json(content: object) -> tuple[bytes, str]:
    return json.dumps(content).encode(), "application/json"
