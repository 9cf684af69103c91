"""Frames of many trackers that send without a pause: frames a second, and processor time of each.

    python -m benchmarks.speed.tracker_load

Clients and server share cores.
"""

from __future__ import annotations

import asyncio
import json
import secrets
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psutil

from benchmarks.tables import Table, parser_of, publish
from calibgraph import MatcherErrors, Rig, perturb, simulate_correspondences
from calibgraph.arrays import Array
from calibgraph.simulation.rigs import rig_of
from calibgraph.yaml_text import yaml_text

_FRAMES = 20
_MATCHES = 20
_READY_S = 120.0
_COLUMNS = ("u_px", "v_px", "x_m", "y_m", "z_m")
BEFORE = 30  # frames, after which a tracker has started
CASES = ((1, 1, 100), (1, 10, 200), (20, 1, 50), (20, 10, 100), (200, 1, 10), (200, 10, 50))


class Server:
    """``calibgraph serve`` in a process of its own, on a port of loopback.

    Args:
        data: its folder.
        port: number.
    """

    def __init__(self, data: Path, port: int) -> None:
        self.url = f"http://127.0.0.1:{port}"
        words = ["serve", "--data", str(data), "--port", str(port), "--free-gb", "0"]
        command, path = [sys.executable, "-m", "calibgraph", *words], data.with_suffix(".log")
        with path.open("ab") as log:
            self.process = psutil.Popen(command, stdout=log, stderr=subprocess.STDOUT)
        end = time.monotonic() + _READY_S
        while time.monotonic() < end:
            if self.process.poll() is not None:
                raise RuntimeError(f"the server has ended: {path.read_text('utf-8')}")
            with suppress(httpx.HTTPError):
                if httpx.get(f"{self.url}/healthz", timeout=5).status_code == httpx.codes.OK:
                    return
            time.sleep(0.05)
        raise TimeoutError(f"no server at {self.url}: {path.read_text('utf-8')}")

    def stop(self) -> None:
        """End it as SIGTERM does."""
        self.process.terminate()
        self.process.wait(60)

    def processor_s(self) -> Array:
        """Of the workers, of those too that have ended, the server and this process so far."""
        own = self.process.cpu_times()
        workers = [one.cpu_times() for one in self.process.children(recursive=True)]
        of_workers = sum(sum(each[:4]) for each in workers) + sum(own[2:4])
        return np.array([of_workers, sum(own[:2]), time.process_time()])


def measure_costs(server: Server, cases: Sequence[tuple[int, int, int]] = CASES) -> Table:
    """Processor time of a frame, by trackers, frames of a request and frames of each tracker."""
    rows = tuple(asyncio.run(_measure_cost(server, *case)) for case in cases)
    columns = ("trackers", "frames a request", "frames/s", "workers ms", "server ms", "client ms")
    return Table("Processor time of a frame", columns, rows)


async def _measure_cost(
    server: Server, trackers: int, together: int, frames: int
) -> tuple[str, ...]:
    truth = rig_of("kitti")
    guess = perturb(truth, rotation_deg=0.5, translation_m=0.05, seed=1)
    bodies = frame_bodies(truth)
    lines = [
        json.dumps({"frame": i, "cameras": bodies[i % _FRAMES]}) for i in range(BEFORE + frames)
    ]

    async def send(place: str, first: int, end: int) -> None:
        for at in range(first, end, together):
            content = "\n".join(lines[at : min(at + together, end)])
            answer = await http.post(place, content=content)
            answer.raise_for_status()

    limits = httpx.Limits(max_connections=None, max_keepalive_connections=trackers)
    async with httpx.AsyncClient(base_url=server.url, timeout=120, limits=limits) as http:
        places = [await _begin(http, guess) for _ in range(trackers)]
        await asyncio.gather(*(send(place, 0, BEFORE) for place in places))
        begun, start = server.processor_s(), time.monotonic()
        await asyncio.gather(*(send(place, BEFORE, BEFORE + frames) for place in places))
        used, wall_s = server.processor_s() - begun, time.monotonic() - start
        for place in places:
            (await http.delete(place)).raise_for_status()
    each_ms = 1e3 * used / (trackers * frames)
    rate = f"{trackers * frames / wall_s:.0f}"
    return str(trackers), str(together), rate, *(f"{ms:.2f}" for ms in each_ms)


def frame_bodies(truth: Rig) -> list[Any]:
    """``cameras`` of some frames of a rig, as a line of JSON has them."""
    table = simulate_correspondences(
        truth, frames=_FRAMES, matches=_MATCHES, errors=MatcherErrors(noise_px=1.0), seed=1
    )
    bodies: list[dict[str, dict[str, list[float]]]] = [{} for _ in range(_FRAMES)]
    for row in table.to_arrow().to_pylist():
        columns = bodies[row["frame"]].setdefault(row["camera"], {n: [] for n in _COLUMNS})
        for name in _COLUMNS:
            columns[name].append(row[name])
    return bodies


async def _begin(http: httpx.AsyncClient, rig: Rig) -> str:
    place = f"/v1/trackers/{secrets.token_hex(8)}"
    content = yaml_text(rig.model_dump(mode="json"))
    (await http.put(place, content=content)).raise_for_status()
    return place


def main() -> None:
    """Run the benchmark."""
    parser = parser_of(__doc__)
    parser.add_argument("--port", type=int, default=8395)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        server = Server(Path(temporary) / "data", options.port)
        try:
            publish([measure_costs(server)])
        finally:
            server.stop()


if __name__ == "__main__":
    main()
