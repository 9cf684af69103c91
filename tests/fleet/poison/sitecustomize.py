"""Poison for the jobs of a test: tables whose names are what happens to their process.

Python imports this module at its start where its folder is on the path.
"""

import os
import signal
import sys
import time
from typing import Any

ILLS: dict[str, Any] = {
    "killed": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "endless": lambda: time.sleep(1000),
    "hungry": lambda: bytearray(8 * 10**9),
    "bug": lambda: {}["key"],
}

if "calibgraph.fleet.job" in " ".join(sys.orig_argv):
    from calibgraph import pipeline

    solve = pipeline.solve

    def poisoned(rig: Any, table: Any, *others: Any) -> Any:
        ILLS.get(table.stem, lambda: None)()
        return solve(rig, table, *others)

    pipeline.solve = poisoned
