"""A discrete simulation of a fleet's run: slots, one driver, lost workers, stragglers."""

from __future__ import annotations

import heapq
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibgraph.fleet.task import RETRIES

AHEAD = 2  # tasks submitted per slot, as calibgraph.fleet.driver does


@dataclass(frozen=True)
class Plan:
    """What a run is simulated with.

    Attributes:
        slots: jobs at once.
        driver_s: of the driver per outcome: take it, publish its row and log, submit another.
        start_s: of a slot at its beginning, and after a lost worker.
        losses_per_hour: of each slot: a killed process, a machine taken back.
        straggler_share: of the tries that take longer.
        straggler_factor: by which they take longer.
        timeout_s: after which a try is ended.
    """

    slots: int
    driver_s: float
    start_s: float
    losses_per_hour: float = 0.0
    straggler_share: float = 0.0
    straggler_factor: float = 1.0
    timeout_s: float = np.inf


@dataclass(frozen=True)
class Result:
    """What a simulated run came to.

    Attributes:
        wall_s: from the first job to the last row.
        slot_use: share of the slots' time in which they ran a try that was of use.
        driver_use: share of the time in which the driver was busy.
        retries: tries beyond the first.
        failed: jobs that used up their tries.
    """

    wall_s: float
    slot_use: float
    driver_use: float
    retries: int
    failed: int


def simulate(seconds: NDArray[np.float64], plan: Plan, rng: np.random.Generator) -> Result:
    """Simulate a run.

    Args:
        seconds: (n,) of each job without loss or straggling, in the order of the jobs.
        plan: the machines.
        rng: of losses and stragglers.
    """
    waiting = deque((job, 0) for job in range(len(seconds)))
    queue = deque[tuple[int, int, float]]()  # job, try, and when it was submitted
    free = [(0.0, plan.start_s)] * plan.slots  # per idle slot, since when, and time to start it
    ends: list[tuple[float, int, int, str]] = []  # time, job, try, kind of failure
    driver_free = useful = 0.0
    retries = failed = 0
    while waiting or queue or ends:
        while waiting and len(queue) + len(ends) < AHEAD * plan.slots:
            queue.append((*waiting.popleft(), driver_free))
        while queue and free:
            job, number, submitted = queue.popleft()
            idle_since, start_s = heapq.heappop(free)
            length, kind = _draw(seconds[job], start_s, plan, rng)
            start = max(idle_since, submitted)
            heapq.heappush(ends, (start + length, job, number, kind))
        time_s, job, number, kind = heapq.heappop(ends)
        heapq.heappush(free, (time_s, plan.start_s if kind else 0.0))
        driver_free = max(driver_free, time_s) + plan.driver_s
        if not kind:
            useful += seconds[job]
        elif number < RETRIES[kind]:  # type: ignore[index]
            waiting.append((job, number + 1))
            retries += 1
        else:
            failed += 1
    return Result(
        driver_free, useful / (plan.slots * driver_free),
        plan.driver_s * (len(seconds) + retries) / driver_free, retries, failed,
    )  # fmt: skip


def _draw(
    seconds: float, start_s: float, plan: Plan, rng: np.random.Generator
) -> tuple[float, str]:
    """Length of a try, and what ends it: nothing, the time limit, or the loss of its worker."""
    length = seconds * (plan.straggler_factor if rng.random() < plan.straggler_share else 1.0)
    kind = ""
    if length > plan.timeout_s:
        length, kind = plan.timeout_s, "timeout"
    length += start_s
    loss = rng.exponential(3600 / plan.losses_per_hour) if plan.losses_per_hour else np.inf
    return (loss, "worker died") if loss < length else (length, kind)
