"""Frames of many trackers that send without a pause: frames a second, and processor time of each.

    python -m benchmarks.speed.tracker_load

Clients and server share cores.
"""

import asyncio
import json
import secrets
import signal
import tempfile
import time
from pathlib import Path

import httpx
import numpy as np

from benchmarks.tables import Table, parser_of, publish
from calibgraph import MatcherErrors, Rig, perturb, simulate_correspondences
from calibgraph.arrays import Array
from calibgraph.simulation.rigs import rig_of
from calibgraph.yaml_text import yaml_text
from tests.service.serving import Server, frames_of

_FRAMES, _MATCHES = 20, 20
BEFORE = 30  # frames, after which a tracker has started
CASES = ((1, 1, 100), (1, 10, 200), (20, 1, 50), (20, 10, 100), (200, 1, 10), (200, 10, 50))


def processor_s(server: Server) -> Array:
    """Of all workers, running or ended, of the server and of this process so far."""
    own = server.process.cpu_times()
    workers = [one.cpu_times() for one in server.process.children(recursive=True)]
    of_workers = sum(sum(each[:4]) for each in workers) + sum(own[2:4])
    return np.array([of_workers, sum(own[:2]), time.process_time()])


def measure_costs(server: Server) -> Table:
    """Processor time of a frame, by trackers, frames of a request and frames of each tracker."""
    rows = tuple(asyncio.run(_measure_cost(server, *case)) for case in CASES)
    columns = ("trackers", "frames a request", "frames/s", "workers ms", "server ms", "client ms")
    return Table("Processor time of a frame", columns, rows)


async def _measure_cost(
    server: Server, trackers: int, together: int, frames: int
) -> tuple[str, ...]:
    truth = rig_of("kitti")
    guess = perturb(truth, rotation_deg=0.5, translation_m=0.05, seed=1)
    errors = MatcherErrors(noise_px=1.0)
    table = simulate_correspondences(truth, frames=_FRAMES, matches=_MATCHES, errors=errors, seed=1)
    bodies = frames_of(table.to_arrow())
    lines = [
        json.dumps({"frame": i, "cameras": bodies[i % _FRAMES]}) for i in range(BEFORE + frames)
    ]

    async def send(place: str, first: int, end: int) -> None:
        for at in range(first, end, together):
            content = "\n".join(lines[at : min(at + together, end)])
            answer = await http.post(place, content=content)
            answer.raise_for_status()

    limits = httpx.Limits(max_connections=None, max_keepalive_connections=trackers)
    async with httpx.AsyncClient(base_url=server.http.base_url, timeout=120, limits=limits) as http:
        places = [await _begin(http, guess) for _ in range(trackers)]
        await asyncio.gather(*(send(place, 0, BEFORE) for place in places))
        begun, start = processor_s(server), time.monotonic()
        await asyncio.gather(*(send(place, BEFORE, BEFORE + frames) for place in places))
        used, wall_s = processor_s(server) - begun, time.monotonic() - start
        for place in places:
            (await http.delete(place)).raise_for_status()
    each_ms = 1e3 * used / (trackers * frames)
    rate = f"{trackers * frames / wall_s:.0f}"
    return str(trackers), str(together), rate, *(f"{ms:.2f}" for ms in each_ms)


async def _begin(http: httpx.AsyncClient, rig: Rig) -> str:
    place = f"/v1/trackers/{secrets.token_hex(8)}"
    content = yaml_text(rig.model_dump(mode="json"))
    (await http.put(place, content=content)).raise_for_status()
    return place


def main() -> None:
    """Run the benchmark."""
    parser_of(__doc__).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        server = Server(Path(folder) / "data")
        server.start()
        try:
            publish([measure_costs(server)])
        finally:
            server.end(signal.SIGTERM)


if __name__ == "__main__":
    main()
