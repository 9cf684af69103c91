"""Poison for the children of a test: vehicles whose names are what happens to their process.

Python imports this module at its start where its folder is on the path.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

ILLS: dict[str, Any] = {
    "segfault": lambda: os.kill(os.getpid(), signal.SIGSEGV),
    "killed": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "endless": lambda: time.sleep(1000),
    "hungry": lambda: bytearray(8 * 10**9),
    "bug": lambda: {}["key"],
}

if "calibgraph.fleet.child" in " ".join(sys.orig_argv):
    from calibgraph.fleet import execute

    calibrate = execute._calibrate

    def poisoned(task: Any, local: Any) -> Any:
        vehicle = task.job.vehicle
        if folder := os.environ.get("COUNT_STARTS"):
            with Path(folder, vehicle).open("a") as file:
                file.write("start\n")
        ILLS.get(vehicle, lambda: None)()
        return calibrate(task, local)

    execute._calibrate = poisoned
