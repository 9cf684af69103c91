"""A server of its own process for the benchmarks."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import httpx
import psutil

_READY_S = 120.0


class Server:
    """``calibgraph serve`` on a port of loopback.

    Args:
        data: its folder.
        port: number.
        options: further ones of the command.
    """

    def __init__(self, data: Path, port: int, options: Sequence[str] = ()) -> None:
        self.url = f"http://127.0.0.1:{port}"
        self._words = [
            sys.executable, "-m", "calibgraph", "serve", "--data", str(data),
            "--port", str(port), "--free-gb", "0", *options,
        ]  # fmt: skip
        self._log = data.with_suffix(".log")

    def start(self) -> None:
        """Start it and wait until it can work."""
        with self._log.open("ab") as log:
            self.process = psutil.Popen(self._words, stdout=log, stderr=subprocess.STDOUT)
        end = time.monotonic() + _READY_S
        while time.monotonic() < end:
            if self.process.poll() is not None:
                raise RuntimeError(f"the server has ended; see {self._log}")
            with suppress(httpx.HTTPError):
                if httpx.get(f"{self.url}/healthz", timeout=5).status_code == httpx.codes.OK:
                    return
            time.sleep(0.05)
        raise TimeoutError(f"no server at {self.url}; see {self._log}")

    def stop(self) -> None:
        """End it as SIGTERM does."""
        self.process.terminate()
        self.process.wait(60)

    def workers(self) -> list[psutil.Process]:
        """The processes of jobs and trackers."""
        return list(self.process.children(recursive=True))

    def memory_mb(self) -> tuple[float, float]:
        """Resident memory of the server and of the largest worker."""
        workers = [process.memory_info().rss for process in self.workers()]
        return self.process.memory_info().rss / 1e6, max(workers, default=0) / 1e6

    def own_processor_s(self) -> float:
        """Processor time of the server alone so far."""
        return sum(self.process.cpu_times()[:2])

    def processor_s(self) -> float:
        """Processor time of the server and its workers so far, of those too that have ended."""
        return sum(sum(process.cpu_times()[:4]) for process in (self.process, *self.workers()))
