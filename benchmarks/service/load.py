"""Many clients at once on loopback: what is lost, what is mixed up, how long it takes.

    python -m benchmarks.service.load [--clients 500] [--seconds 300] [--trackers 200] [--hz 10]

Each client submits one of 50 small solves (two cameras, three frames) with a key of its own, waits
for it, fetches its result and compares it with the library's; then the next. Overhead: processor
time of the server and its workers per solve, less that of the library in one process that reads the
same files and writes the same result, measured before and after. Trackers: each gets a frame every
1 / hz seconds; a frame counts when it is acknowledged. Before, the processor time of a frame, of
trackers that send without a pause. Clients and server share the cores.
"""

from __future__ import annotations

import argparse
import asyncio
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import numpy as np

from benchmarks.service.server import SETTINGS, Problem, Server, make_problems
from benchmarks.service.tracker_load import measure_costs, track
from benchmarks.tables import Table, add_record_option, publish
from calibgraph import load_rig, solve
from calibgraph.report.html import write_result

PROBLEMS = 50
RETRY_S = 1.0
_BUSY = (429, 503)


@dataclass
class Counts:
    """What clients saw.

    Attributes:
        seconds: from the request to the result, of each job.
        acknowledged: ids of the jobs.
        wrong: results of another problem, or none.
        busy: refusals for the time being.
        broken: requests without an answer, which were sent again.
        memory_mb: of the server and the largest worker, over time.
    """

    seconds: list[float] = field(default_factory=list)
    acknowledged: set[str] = field(default_factory=set)
    wrong: int = 0
    busy: int = 0
    broken: int = 0
    memory_mb: list[tuple[float, float]] = field(default_factory=list)


async def submit_all(
    server: Server, problems: list[Problem], clients: int, seconds: float
) -> Counts:
    """Let clients ask for solves for some time; all that was begun is waited for."""
    counts, end = Counts(), time.monotonic() + seconds
    limits = httpx.Limits(max_connections=None, max_keepalive_connections=clients)
    async with httpx.AsyncClient(base_url=server.url, timeout=600, limits=limits) as http:
        watching = asyncio.create_task(_watch(server, counts))
        await asyncio.gather(
            *(_one(http, problems, number, end, counts) for number in range(clients))
        )
        watching.cancel()
    return counts


async def _watch(server: Server, counts: Counts) -> None:
    while True:
        counts.memory_mb.append(server.memory_mb())
        await asyncio.sleep(5)


async def _one(
    http: httpx.AsyncClient, problems: list[Problem], number: int, end: float, counts: Counts
) -> None:
    """A client: one job after the other."""
    turn = 0
    while time.monotonic() < end:
        problem = problems[(number + turn) % len(problems)]
        start = time.perf_counter()
        id = await _submit(http, problem, f"{number}-{turn}", counts)
        if await _is_right(http, id, problem, counts):
            counts.seconds.append(time.perf_counter() - start)
        else:
            counts.wrong += 1
        turn += 1


async def _submit(http: httpx.AsyncClient, problem: Problem, key: str, counts: Counts) -> str:
    while True:
        headers = {"Idempotency-Key": key}
        try:
            answer = await http.post(
                "/v1/solves", files=problem.files, data={"settings": SETTINGS}, headers=headers
            )
        except httpx.TransportError:
            counts.broken += 1
            continue
        if answer.status_code not in _BUSY:
            id = str(answer.raise_for_status().json()["id"])
            counts.acknowledged.add(id)
            return id
        counts.busy += 1
        await asyncio.sleep(RETRY_S)


async def _is_right(http: httpx.AsyncClient, id: str, problem: Problem, counts: Counts) -> bool:
    while True:
        try:
            answer = await http.get(f"/v1/jobs/{id}", params={"wait_s": 60})
        except httpx.TransportError:
            counts.broken += 1
            continue
        job = answer.raise_for_status().json()
        if job["state"] not in ("queued", "running"):
            break
    if job["state"] != "succeeded":
        return False
    result = (await http.get(f"/v1/jobs/{id}/result")).raise_for_status().json()
    return problem.is_answered_by(result)


def library_s(folder: Path, count: int) -> float:
    """Processor time of the library per solve that reads and writes files."""
    for i in range(3):
        _solve(folder / str(i), folder / "out")
    start = time.process_time()
    for i in range(count):
        _solve(folder / str(i), folder / "out")
    return (time.process_time() - start) / count


def _solve(problem: Path, out: Path) -> None:
    result = solve(load_rig(problem / "rig.yaml"), problem / "table.parquet")
    write_result(result, out, None, with_report=False)


def _table(counts: Counts, wall_s: float, used_s: tuple[float, float], alone_s: float) -> Table:
    own_s, server_s = used_s
    done = len(counts.seconds)
    p50, p99 = np.percentile(counts.seconds, [50, 99])
    first, last = counts.memory_mb[len(counts.memory_mb) // 4], counts.memory_mb[-1]
    rows = (
        ("acknowledged", f"{len(counts.acknowledged)}"),
        ("right results", f"{done}"),
        ("wrong, lost", f"{counts.wrong}, {len(counts.acknowledged) - done - counts.wrong}"),
        ("refused for the time being (429)", f"{counts.busy}"),
        ("sent again after no answer", f"{counts.broken}"),
        ("solves per second", f"{done / wall_s:.1f}"),
        ("request to result, p50 s", f"{p50:.2f}"),
        ("request to result, p99 s", f"{p99:.2f}"),
        ("library alone, processor ms a solve", f"{1e3 * alone_s:.1f}"),
        ("service, processor ms a solve", f"{1e3 * server_s / done:.1f}"),
        ("of these the server without its workers", f"{1e3 * own_s / done:.1f}"),
        ("overhead, processor ms a solve", f"{1e3 * (server_s / done - alone_s):.1f}"),
        ("server MB, at a quarter and at the end", f"{first[0]:.0f}, {last[0]:.0f}"),
        ("largest worker MB, the same", f"{first[1]:.0f}, {last[1]:.0f}"),
    )
    return Table(f"Solves of many clients, {wall_s:.0f} s", ("what", "found"), rows)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clients", type=int, default=500)
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--trackers", type=int, default=200)
    parser.add_argument("--hz", type=float, default=10.0)
    parser.add_argument("--port", type=int, default=8395)
    add_record_option(parser)
    options = parser.parse_args()
    tables = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        problems = make_problems(folder / "problems", PROBLEMS)
        server = Server(folder / "data", options.port)
        try:
            server.start()
            if options.clients:
                before_s = library_s(folder / "problems", PROBLEMS)
                asyncio.run(submit_all(server, problems, 4, 10))  # workers are warm
                begun_s, start = server.processor_s(), time.monotonic()
                own_s = server.own_processor_s()
                counts = asyncio.run(submit_all(server, problems, options.clients, options.seconds))
                wall_s, used_s = time.monotonic() - start, server.processor_s() - begun_s
                own_s = server.own_processor_s() - own_s
                alone_s = (before_s + library_s(folder / "problems", PROBLEMS)) / 2
                tables.append(_table(counts, wall_s, (own_s, used_s), alone_s))
            if options.trackers:
                tables.append(measure_costs(server))
                tables.append(track(server, options.trackers, options.hz, options.seconds))
        finally:
            server.stop()
    publish("service.load", tables, record=options.record)


if __name__ == "__main__":
    main()
