"""A process of its own for jobs, see :mod:`calibgraph.child_process`."""

import shutil
import threading
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from calibgraph.child_process import (
    ChildEndedError,
    ChildProcess,
    ChildTimeoutError,
    answer_requests,
    memory_limit,
    output_to,
)
from calibgraph.errors import CalibrationError
from calibgraph.fleet.task import Outcome, Task, release

_LOG, _MOST_LOG = "log.txt", 2**16


class Child:
    """A process that runs one job at a time; it is started when needed, and again after a crash."""

    def __init__(self) -> None:
        self._process = ChildProcess(__name__)

    def run(self, task: Task) -> Outcome:
        """Run a job.

        Raises:
            CalibrationError: if this process and the one that made the task have different
                versions of the package.
        """
        if task.release != release():
            raise CalibrationError(
                f"a worker has calibgraph {release()}, the command {task.release}; install the "
                "same version on all machines"
            )
        with TemporaryDirectory(prefix="calibgraph-fleet-") as folder:
            start = time.perf_counter()
            try:
                self._process.start()
                start = time.perf_counter()  # the libraries' loading is not the job's time
                outcome = self._ask(task, Path(folder))
            except ChildEndedError as error:
                outcome = Outcome(error_kind="worker died", error=str(error))
            seconds, log = time.perf_counter() - start, _tail(Path(folder) / _LOG)
        return replace(outcome, seconds=seconds, log=log)

    def _ask(self, task: Task, folder: Path) -> Outcome:
        try:
            outcome: Outcome = self._process.ask((task, folder), task.limits.timeout_s)
        except ChildTimeoutError as error:
            return Outcome(error_kind="timeout", error=f"{error}; see --timeout-s")
        return outcome

    def interrupt(self) -> None:
        """End the process, and with it the job that runs in another thread; start no other."""
        self._process.interrupt()

    def close(self) -> None:
        """End the process, when no other thread uses it."""
        self._process.close()


_kept = threading.local()


def run_in_kept_child(task: Task) -> Outcome:
    """Run a job in the child of this thread, which lives as long as the thread's process."""
    if not hasattr(_kept, "child"):
        _kept.child = Child()
    child: Child = _kept.child
    return child.run(task)


def _tail(path: Path) -> str:
    """The end of a log."""
    if not path.exists():
        return ""
    return path.read_bytes()[-_MOST_LOG:].decode(errors="replace")


def main() -> None:
    """The child's side."""
    import calibgraph.pipeline  # noqa: F401 - it takes seconds, which are not the first job's
    from calibgraph.fleet.execute import execute

    fetched: list[Path] = []

    def answer(request: tuple[Task, Path], _: object) -> Outcome:
        task, folder = request
        fetched[:] = [folder]
        with output_to(folder / _LOG), memory_limit(task.limits.memory_bytes):
            return execute(task, folder)

    def remove_fetched() -> None:
        for folder in fetched:
            shutil.rmtree(folder, ignore_errors=True)

    answer_requests(answer, remove_fetched)


if __name__ == "__main__":
    main()
