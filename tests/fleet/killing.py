"""Kills workers of an engine, at random times."""

from __future__ import annotations

import random
import threading

import psutil

_WORKERS = (
    "calibgraph.fleet.child",
    "ray::run_in_kept_child",
    "multiprocessing.spawn",
    "multiprocessing-fork",
)


def kill_at_random(stop: threading.Event, kills: list[int], most: int = 50) -> None:
    """Kill one of the workers below this process every half second or so."""
    rng = random.Random(0)
    while kills[0] < most and not stop.wait(rng.uniform(0.2, 0.8)):
        below = psutil.Process().children(recursive=True)
        workers = [each for each in below if _is_worker(each)]
        if any(map(_is_job, workers)):
            rng.choice(workers).kill()
            kills[0] += 1


def _is_job(process: psutil.Process) -> bool:
    """Whether it is a job's process: before the first, a cluster is still starting."""
    try:
        return "calibgraph.fleet.child" in process.cmdline()
    except psutil.Error:
        return False


def _is_worker(process: psutil.Process) -> bool:
    try:
        command = " ".join(process.cmdline())
    except psutil.Error:
        return False
    return any(name in command for name in _WORKERS) and "IDLE" not in command
