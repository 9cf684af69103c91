"""Frames to many trackers of ``calibgraph serve`` at a rate: what is acknowledged, and its cost.

    python -m benchmarks.service.tracker_load [--trackers 200] [--hz 10] [--seconds 60]

First, the processor time of a frame, by the number of trackers and the frames of a request; then
frames at a rate: one that is late does not delay the others, and a tracker whose last acknowledged
frame is not in its state has lost it.
"""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import numpy as np
import psutil

from benchmarks.tables import Table, parser_of, publish
from calibgraph import MatcherErrors, perturb, simulate_correspondences
from calibgraph.arrays import Array
from calibgraph.simulation.rigs import rig_of

FRAMES, MATCHES = 20, 20
MOST_AT_ONCE = 10  # frames: a robot that has waited for long drops older ones
BEFORE = 30  # frames, after which a tracker has started
CASES = ((1, 1, 100), (1, 10, 200), (20, 1, 50), (20, 10, 100), (200, 1, 10), (200, 10, 50))
COLUMNS = ("u_px", "v_px", "x_m", "y_m", "z_m")


@dataclass
class Counts:
    """What was acknowledged; ``last``: the last frame of each tracker that was."""

    seconds: list[float] = field(default_factory=list)
    frames: int = 0
    skipped: int = 0
    refused: int = 0
    memory_mb: list[tuple[float, float]] = field(default_factory=list)
    last: dict[str, int] = field(default_factory=dict)


@contextmanager
def serving(folder: Path, port: int) -> Iterator[psutil.Process]:
    """A server on a port of loopback that answers."""
    words = ["serve", "--data", str(folder / "data"), "--port", str(port), "--free-gb", "0"]
    log = folder / "log"
    with log.open("wb") as file:
        process = psutil.Popen([sys.executable, "-m", "calibgraph", *words], stdout=file,
                               stderr=subprocess.STDOUT)  # fmt: skip
    try:
        for _ in range(1200):
            with suppress(httpx.HTTPError):
                if httpx.get(f"http://127.0.0.1:{port}/healthz", timeout=5).is_success:
                    break
            if process.poll() is not None:
                raise RuntimeError(log.read_text("utf-8", "replace"))
            time.sleep(0.1)
        yield process
    finally:
        process.terminate()
        process.wait(60)


def processor_s(server: psutil.Process) -> Array:
    """Of the workers, the server and this process so far."""
    own_s, every = sum(server.cpu_times()[:2]), (server, *server.children(recursive=True))
    whole_s = sum(sum(process.cpu_times()[:4]) for process in every)
    return np.array([whole_s - own_s, own_s, time.process_time()])


def memory_mb(server: psutil.Process) -> tuple[float, float]:
    """Resident memory of the server and of the largest worker."""
    workers = [process.memory_info().rss for process in server.children(recursive=True)]
    return server.memory_info().rss / 1e6, max(workers, default=0) / 1e6


def frame_bodies() -> list[dict[str, dict[str, list[float]]]]:
    """``cameras`` of some frames, as a line of JSON has them."""
    errors, bodies = MatcherErrors(noise_px=1.0), [dict() for _ in range(FRAMES)]
    table = simulate_correspondences(
        rig_of("kitti"), frames=FRAMES, matches=MATCHES, errors=errors, seed=1
    )
    for row in table.to_arrow().to_pylist():
        columns = bodies[row["frame"]].setdefault(row["camera"], {name: [] for name in COLUMNS})
        for name in COLUMNS:
            columns[name].append(row[name])
    return bodies


BODIES = frame_bodies()


def lines(first: int, end: int) -> str:
    """Frames, a line each."""
    return "\n".join(json.dumps({"frame": i, "cameras": BODIES[i % FRAMES]})
                     for i in range(first, end))  # fmt: skip


async def begin(http: httpx.AsyncClient, count: int) -> list[str]:
    """The addresses of new trackers."""
    guess = perturb(rig_of("kitti"), rotation_deg=0.5, translation_m=0.05, seed=1)
    body, places = json.dumps(guess.model_dump(mode="json")), [f"/{i}" for i in range(count)]
    for place in places:
        (await http.put(place, content=body)).raise_for_status()
    return places


async def measure_cost(
    http: httpx.AsyncClient, server: psutil.Process, trackers: int, together: int, frames: int
) -> tuple[str, ...]:
    """Processor time of a frame: a row."""

    async def send(place: str, first: int, end: int) -> None:
        for at in range(first, end, together):
            answer = await http.post(place, content=lines(at, min(at + together, end)))
            answer.raise_for_status()

    places = await begin(http, trackers)
    await asyncio.gather(*(send(place, 0, BEFORE) for place in places))
    begun, start = processor_s(server), time.monotonic()
    await asyncio.gather(*(send(place, BEFORE, BEFORE + frames) for place in places))
    used, wall_s = processor_s(server) - begun, time.monotonic() - start
    for place in places:
        (await http.delete(place)).raise_for_status()
    each_ms, rate = 1e3 * used / (trackers * frames), trackers * frames / wall_s
    return str(trackers), str(together), f"{rate:.0f}", *(f"{ms:.2f}" for ms in each_ms)


async def track(
    http: httpx.AsyncClient, server: psutil.Process, trackers: int, hz: float, seconds: float
) -> Table:
    """Send frames to trackers for some time."""
    places, counts, start = await begin(http, trackers), Counts(), time.monotonic()

    async def watch() -> None:
        while True:
            counts.memory_mb.append(memory_mb(server))
            await asyncio.sleep(min(5.0, seconds / 8))

    watching = asyncio.create_task(watch())
    await asyncio.gather(*(drive(http, place, start + index / trackers / hz, hz, seconds, counts)
                           for index, place in enumerate(places)))  # fmt: skip
    watching.cancel()
    wall_s, lost = time.monotonic() - start, 0
    for place, last in counts.last.items():
        lost += (await http.get(place)).raise_for_status().json()["frame"] != last
    p50, p99 = np.percentile(counts.seconds, [50, 99])
    early, late = counts.memory_mb[len(counts.memory_mb) // 4], counts.memory_mb[-1]
    rows = (
        ("frames per second wanted", f"{trackers * hz:.0f}"),
        ("frames per second acknowledged", f"{counts.frames / wall_s:.0f}"),
        ("frames acknowledged", f"{counts.frames}"),
        ("trackers whose last acknowledged frame is not in their state", f"{lost}"),
        ("frames not sent: the service was behind", f"{counts.skipped}"),
        ("requests, refused", f"{len(counts.seconds)}, {counts.refused}"),
        ("frame to acknowledgement, p50 s", f"{p50:.3f}"),
        ("frame to acknowledgement, p99 s", f"{p99:.3f}"),
        ("server MB, at a quarter and at the end", f"{early[0]:.0f}, {late[0]:.0f}"),
        ("largest worker MB, the same", f"{early[1]:.0f}, {late[1]:.0f}"),
    )
    return Table(f"{trackers} trackers at {hz:g} Hz, {wall_s:.0f} s", ("what", "found"), rows)


async def drive(
    http: httpx.AsyncClient, place: str, start: float, hz: float, seconds: float, counts: Counts
) -> None:
    """Send what has come up since the last answer, the newest of it if that is much."""
    frame = 0
    while time.monotonic() < start + seconds:
        due = int((time.monotonic() - start) * hz) + 1
        if due <= frame:
            await asyncio.sleep(max(0.0, start + frame / hz - time.monotonic()))
            continue
        counts.skipped += max(0, due - MOST_AT_ONCE - frame)
        frame, begun = max(frame, due - MOST_AT_ONCE), time.perf_counter()
        answer = await http.post(place, content=lines(frame, due))
        if answer.is_success:
            counts.seconds.append(time.perf_counter() - begun)
            counts.frames += len(answer.json()["updates"])
            frame, counts.last[place] = due, due - 1
        else:
            counts.refused += 1
            await asyncio.sleep(1)


async def measure(server: psutil.Process, port: int, trackers: int, hz: float, seconds: float
                  ) -> list[Table]:  # fmt: skip
    """Both tables."""
    limits = httpx.Limits(max_connections=None, max_keepalive_connections=trackers)
    url = f"http://127.0.0.1:{port}/v1/trackers"
    async with httpx.AsyncClient(base_url=url, timeout=120, limits=limits) as http:
        heads = ("trackers", "frames a request", "frames/s", "workers ms", "server ms", "client ms")
        rows = [await measure_cost(http, server, *case) for case in CASES if case[0] <= trackers]
        costs = Table("Processor time of a frame", heads, tuple(rows))
        return [costs, await track(http, server, trackers, hz, seconds)]


def main() -> None:
    """Serve, send, print."""
    parser = parser_of(__doc__)
    parser.add_argument("--trackers", type=int, default=200)
    parser.add_argument("--hz", type=float, default=10.0)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--port", type=int, default=8377)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, serving(Path(name), asked.port) as server:
        found = measure(server, asked.port, asked.trackers, asked.hz, asked.seconds)
        publish("service.tracker_load", asyncio.run(found), record=asked.record)


if __name__ == "__main__":
    main()
