"""The page's server: it answers this machine alone, at an address that nobody else knows."""

from __future__ import annotations

import json
import secrets
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from urllib.parse import unquote

from pydantic import TypeAdapter, ValidationError

from calibgraph.errors import CalibrationError
from calibgraph.pick.estimate import Pair
from calibgraph.pick.workspace import Workspace

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
        """The page, or data of the session."""
        self._answer(self._get)

    def do_POST(self) -> None:
        """Change the session, or write what it gives."""
        self._answer(self._post)

    def _answer(self, respond: object) -> None:
        parts = self.path.split("?")[0].split("/")
        host, origin = f"127.0.0.1:{self.server.server_port}", self.headers.get("Origin")
        if self.headers.get("Host") != host or origin not in (None, f"http://{host}"):
            return self._send(403, b"not from here", "text/plain")
        if len(parts) < 3 or not secrets.compare_digest(parts[1], self.server.key):  # noqa: PLR2004
            return self._send(404, b"no such page", "text/plain")
        try:
            assert callable(respond)
            return self._send(200, *respond([unquote(part) for part in parts[2:]]))
        except (CalibrationError, ValidationError, ValueError, LookupError) as error:
            line = str(error).partition("\n")[0]
            return self._send(400, json.dumps({"error": line}).encode(), "application/json")
        except OSError as error:
            return self._send(500, json.dumps({"error": str(error)}).encode(), "application/json")

    def _get(self, parts: list[str]) -> tuple[bytes, str]:
        workspace = self.server.workspace
        match parts:
            case ["session"]:
                return _json(workspace.state())
            case ["cloud", frame]:
                return workspace.cloud(int(frame)).tobytes(), "application/octet-stream"
            case ["image", frame, camera]:
                return workspace.image(int(frame), camera), "image/jpeg"
            case ["projected", frame, camera]:
                points = workspace.projected(int(frame), camera)
                return points.tobytes(), "application/octet-stream"
            case [name] if name in _PAGE:
                file, kind = _PAGE[name]
                return files("calibgraph.pick").joinpath("page", file).read_bytes(), kind
        raise LookupError("no such page")

    def _post(self, parts: list[str]) -> tuple[bytes, str]:
        length = int(self.headers.get("Content-Length", "0"))
        if not 0 <= length <= MAX_BODY_BYTES:
            raise ValueError(f"a body of at most {MAX_BODY_BYTES} bytes is expected")
        body = self.rfile.read(length)
        if parts == ["pairs"]:
            return _json(self.server.workspace.change(_PAIRS.validate_json(body)))
        if parts == ["write"]:
            return _json({"files": [str(path) for path in self.server.workspace.write()]})
        raise LookupError("no such page")

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
