"""The server in a process of its own, and frames as programs send them."""

import io
import json
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import psutil
import pyarrow as pa
import pyarrow.parquet as pq

SHORT = (
    "from calibgraph.service import app, request_guard;"
    "request_guard.BODY_S = app.IDLE_S = 2.0;"
    "from calibgraph.cli.app import main; main()"
)
"""The command with shorter waits."""


class Server:
    """``calibgraph serve`` on a port of loopback that stays.

    Args:
        data: its folder.
        options: more words of the command.
        program: words of Python that run the command line.
    """

    def __init__(
        self, data: Path, *options: str, program: tuple[str, ...] = ("-m", "calibgraph")
    ) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self._command = [sys.executable, *program, "serve", "--data", str(data),
                         "--port", str(self.port), "--free-gb", "0", *options]  # fmt: skip
        self._log = data.with_suffix(".log")
        self.http = httpx.Client(base_url=f"http://127.0.0.1:{self.port}", timeout=120)

    def start(self) -> None:
        """Start it, and wait until it answers."""
        with self._log.open("ab") as log:
            self.process = psutil.Popen(
                self._command, stdout=log, stderr=log, stdin=subprocess.DEVNULL
            )
        end = time.monotonic() + 120
        while time.monotonic() < end and self.process.is_running():
            with suppress(httpx.HTTPError):
                if self.http.get("/healthz").status_code == httpx.codes.OK:
                    return
            time.sleep(0.1)
        raise AssertionError(self._log.read_text())

    def end(self, number: int) -> None:
        """Send a signal, and wait."""
        self.process.send_signal(number)
        self.process.wait(60)

    def connect(self) -> socket.socket:
        """A bare connection."""
        connection = socket.create_connection(("127.0.0.1", self.port))
        connection.settimeout(60)
        return connection

    def memory_mb(self) -> float:
        """Resident."""
        return float(self.process.memory_info().rss / 1e6)

    def wait_for(self, at: str) -> dict[str, object]:
        """A job when it is finished."""
        for _ in range(10):
            job: dict[str, object] = self.http.get(at, params={"wait_s": 60}).json()
            if job["finished"]:
                break
        return job


def frames_of(table: pa.Table) -> dict[int, dict[str, Any]]:
    """The cameras of each frame of a table, as a line for a tracker has them."""
    frames: dict[int, dict[str, Any]] = {}
    for row in table.to_pylist():
        columns = frames.setdefault(row["frame"], {}).setdefault(row["camera"], {})
        for name in ("u_px", "v_px", "x_m", "y_m", "z_m"):
            columns.setdefault(name, []).append(row[name])
    return dict(sorted(frames.items()))


def frames_as_lines(table: bytes) -> list[bytes]:
    """The frames of a Parquet table, each as a line for a tracker."""
    return [
        json.dumps({"frame": frame, "cameras": cameras}).encode() + b"\n"
        for frame, cameras in frames_of(pq.read_table(io.BytesIO(table))).items()
    ]
