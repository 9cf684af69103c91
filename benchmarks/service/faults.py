"""kill -9 of the server or of a worker at random moments: is what was acknowledged there, once?

    python -m benchmarks.service.faults [--kills 100] [--seed 0]

Four clients submit small solves with keys, as fast as they are answered, and send every request
again that was not answered; one tracker gets frames in the same way. Meanwhile the server or one of
its workers is killed, after a random time each. At the end every acknowledged job has to have one
result, its own; and the tracker's state every acknowledged frame, once.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import numpy as np
import psutil

from benchmarks.service.server import SETTINGS, Problem, Server, make_problems
from benchmarks.service.tracker_load import frame_bodies
from benchmarks.tables import Table, add_record_option, publish
from calibgraph import perturb
from calibgraph.simulation.rigs import rig_of

CLIENTS = 4
MOST_WAIT_S = 2.0
_AGAIN_S = 0.1
_FINISH_S = 600.0


@dataclass
class Seen:
    """What the clients know.

    Attributes:
        jobs: number of the problem by the job's id.
        other_ids: keys for which two ids were answered.
        repeated: requests that were sent again.
        frames: acknowledged frames of the tracker, in order.
        is_over: no more requests are begun.
    """

    jobs: dict[str, int] = field(default_factory=dict)
    other_ids: int = 0
    repeated: int = 0
    frames: list[int] = field(default_factory=list)
    is_over: bool = False


def _until_answered(seen: Seen, call: Callable[[], httpx.Response]) -> httpx.Response:
    """Send a request again until it succeeds."""
    while True:
        with suppress(httpx.HTTPError):
            answer = call()
            if answer.is_success:
                return answer
        seen.repeated += 1
        time.sleep(_AGAIN_S)


def _submit(url: str, client: int, problems: list[Problem], seen: Seen) -> None:
    turn = 0
    with httpx.Client(base_url=url, timeout=30) as http:
        while not seen.is_over:
            number = (client + turn) % len(problems)
            key = {"Idempotency-Key": f"{client}-{turn}"}

            def call(number: int = number, key: dict[str, str] = key) -> httpx.Response:
                files, data = problems[number].files, {"settings": SETTINGS}
                return http.post("/v1/solves", files=files, data=data, headers=key)

            id = _until_answered(seen, call).json()["id"]
            seen.jobs[id] = number
            if turn % 5 == 0:  # a client that asks once more after the answer
                seen.other_ids += _until_answered(seen, call).json()["id"] != id
            turn += 1
            time.sleep(0.3)


def _track(url: str, place: str, seen: Seen) -> None:
    bodies = frame_bodies(rig_of("kitti"))
    frame = 0
    with httpx.Client(base_url=url, timeout=30) as http:
        while not seen.is_over:
            line = json.dumps({"frame": frame, "cameras": bodies[frame % len(bodies)]})
            kind = {"Content-Type": "application/x-ndjson"}

            def call(line: str = line, kind: dict[str, str] = kind) -> httpx.Response:
                return http.post(f"{place}/frames", content=line, headers=kind)

            answer = _until_answered(seen, call).json()
            if len(answer["updates"]) + answer["known"] == 1:
                seen.frames.append(frame)
            frame += 1
            time.sleep(0.05)


def _kill(server: Server, kills: int, seed: int) -> dict[str, int]:
    """Kill the server or a worker, again and again; how often which."""
    rng, counts = np.random.default_rng(seed), {"server": 0, "worker": 0}
    for _ in range(kills):
        time.sleep(float(rng.uniform(0, MOST_WAIT_S)))
        workers = server.workers()
        if rng.random() < 0.5 or not workers:
            server.kill()
            counts["server"] += 1
            server.start()
        else:
            with suppress(psutil.NoSuchProcess):
                workers[int(rng.integers(len(workers)))].kill()
            counts["worker"] += 1
    return counts


def _check(url: str, place: str, problems: list[Problem], seen: Seen) -> dict[str, int]:
    """What became of the acknowledged jobs and frames."""
    found = {"right": 0, "wrong": 0, "failed": 0, "missing": 0, "listed twice": 0, "not asked": 0}
    end = time.monotonic() + _FINISH_S
    with httpx.Client(base_url=url, timeout=90) as http:
        for id, number in seen.jobs.items():
            answer = http.get(f"/v1/jobs/{id}")
            while answer.is_success and answer.json()["finished"] is None:
                if time.monotonic() > end:
                    break
                answer = http.get(f"/v1/jobs/{id}", params={"wait_s": 30})
            found[_fate(http, answer, problems[number])] += 1
        listed = _listed(http)
        found["listed twice"] = len(listed) - len(set(listed))
        found["not asked"] = len(set(listed) - seen.jobs.keys())
        found["last frame"] = http.get(f"{place}/state").json()["frame"]
    return found


def _fate(http: httpx.Client, answer: httpx.Response, problem: Problem) -> str:
    if not answer.is_success:
        return "missing"
    job = answer.json()
    if job["state"] != "succeeded":
        return "failed"
    result = http.get(f"/v1/jobs/{job['id']}/result").json()
    return "right" if problem.is_answered_by(result) else "wrong"


def _listed(http: httpx.Client) -> list[str]:
    ids: list[str] = []
    before: dict[str, int] = {}
    while True:
        page = http.get("/v1/jobs", params={"limit": 500, **before}).json()
        ids += [job["id"] for job in page["jobs"]]
        if page["next"] is None:
            return ids
        before = {"before": page["next"]}


def run(folder: Path, server: Server, kills: int, seed: int) -> Table:
    """All of it."""
    problems = make_problems(folder / "problems", 10)
    seen = Seen()
    server.start()
    rig = perturb(rig_of("kitti"), rotation_deg=0.5, translation_m=0.05, seed=1)
    body = {"rig": rig.model_dump(mode="json")}
    begun = httpx.post(f"{server.url}/v1/trackers", json=body, timeout=120)
    place = str(begun.raise_for_status().headers["location"])
    threads = [
        threading.Thread(target=_submit, args=(server.url, client, problems, seen), daemon=True)
        for client in range(CLIENTS)
    ]
    threads.append(threading.Thread(target=_track, args=(server.url, place, seen), daemon=True))
    for thread in threads:
        thread.start()
    start = time.monotonic()
    killed = _kill(server, kills, seed)
    seen.is_over = True
    for thread in threads:
        thread.join()
    wall_s = time.monotonic() - start
    found = _check(server.url, place, problems, seen)
    rows = (
        ("kills of the server, of a worker", f"{killed['server']}, {killed['worker']}"),
        ("acknowledged jobs", f"{len(seen.jobs)}"),
        ("requests that were sent again", f"{seen.repeated}"),
        *((f"jobs {name}", f"{number}") for name, number in found.items() if name != "last frame"),
        ("keys with two jobs", f"{seen.other_ids}"),
        ("frames acknowledged, last frame + 1", f"{len(seen.frames)}, {found['last frame'] + 1}"),
    )
    return Table(f"kill -9, {wall_s:.0f} s", ("what", "found"), rows)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--port", type=int, default=8396)
    add_record_option(parser)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        server = Server(Path(temporary) / "data", options.port)
        try:
            table = run(Path(temporary), server, options.kills, options.seed)
        finally:
            server.kill()
    publish("service.faults", [table], record=options.record)


if __name__ == "__main__":
    main()
