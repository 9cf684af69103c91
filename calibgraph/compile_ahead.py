"""A machine's first run: another process compiles the solver's kernels while this one searches."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from threading import Thread

from calibgraph.child_process import (
    ChildEndedError,
    ChildProcess,
    ChildTimeoutError,
    Note,
    answer_requests,
)
from calibgraph.errors import CalibrationError
from calibgraph.model.rig import Rig
from calibgraph.parallel import count_cores
from factors.compiled import is_kept

_FRAMES, _MATCHES = 8, 500  # enough for all checks of a table, and for kernels of large blocks
_TIMEOUT_S = 600.0
_log = logging.getLogger(__name__)


@contextmanager
def compile_ahead(rig: Rig) -> Iterator[None]:
    """Compile what a solve of this rig needs during the ``with``, if no run has kept it.

    A kernel that is needed before it is compiled there is compiled here as well.
    """
    if count_cores() == 1 or is_kept("factors.kernel") is not False:
        yield
        return
    with closing(ChildProcess(__name__)) as child:
        thread = Thread(target=ask_to_compile, args=(child, rig), daemon=True)
        thread.start()
        try:
            yield
        finally:
            child.interrupt()
            thread.join()


def ask_to_compile(child: ChildProcess, rig: Rig) -> None:
    """Have a process compile what a solve of this rig needs, and wait for it.

    Where it fails, only time is lost: the kernels are then compiled when they are used.
    """
    try:
        child.start()
        child.ask(rig, _TIMEOUT_S)
    except (ChildEndedError, ChildTimeoutError) as error:
        _log.debug("kernels are compiled by this process alone: %s", error)


def _compile(rig: Rig, _: Note) -> None:
    from calibgraph.pipeline import solve
    from calibgraph.simulation.correspondences import simulate_correspondences

    with suppress(ValueError, CalibrationError):  # a camera that would see too few points
        solve(rig, simulate_correspondences(rig, frames=_FRAMES, matches=_MATCHES))


if __name__ == "__main__":
    logging.disable()  # what the solve would report is of no data
    answer_requests(_compile)
