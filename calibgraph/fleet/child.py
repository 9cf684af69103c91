"""A process of its own for jobs: a crash, a leak or an endless loop ends it, and nothing else.

It is kept from job to job, because loading the libraries takes longer than a small solve. It is no
process of ``multiprocessing``: workers of Dask may not have such children.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory

from calibgraph.errors import CalibrationError
from calibgraph.fleet.task import Outcome, Task, release
from calibgraph.parallel import THREADS_VARIABLE

Process = subprocess.Popen[bytes]

_LOG, _MOST_LOG = "log.txt", 2**16
_ONE_THREAD = dict.fromkeys(
    (THREADS_VARIABLE, "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)
"""The jobs share the cores, so that each needs one thread only."""


class Child:
    """A process that runs one job at a time; it is started when needed, and again after a crash."""

    def __init__(self) -> None:
        self._process: Process | None = None
        self._connection: Connection | None = None
        self._is_closed = False

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
                process, connection = self._start()
                start = time.perf_counter()  # the libraries' loading is not the job's time
                outcome = self._converse(task, Path(folder), process, connection)
            except (OSError, EOFError) as error:
                outcome = _death(f"no process can be started ({error})")
            seconds, log = time.perf_counter() - start, _tail(Path(folder) / _LOG)
        return replace(outcome, seconds=seconds, log=log)

    def _converse(
        self, task: Task, folder: Path, process: Process, connection: Connection
    ) -> Outcome:
        """Give the job to the process, and wait for its outcome."""
        try:
            connection.send((task, folder))
            if not connection.poll(task.limits.timeout_s):
                self._stop()
                limit = f"{task.limits.timeout_s:g} s"
                return Outcome(error_kind="timeout", error=f"took over {limit}; see --timeout-s")
            outcome: Outcome = connection.recv()
            return outcome
        except (EOFError, OSError):
            self._stop()
            return _death(_how_it_ended(process.wait()))

    def _start(self) -> tuple[Process, Connection]:
        """The process that runs, or a new one."""
        if self._is_closed:
            raise OSError("closed")
        if self._process is not None and self._connection is not None:
            if self._process.poll() is None:
                return self._process, self._connection
            self._stop()
        ours, theirs = Pipe()
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", __name__, str(theirs.fileno())],
            stdin=subprocess.PIPE,  # it ends with this process
            stdout=subprocess.DEVNULL,
            pass_fds=[theirs.fileno()],
            env={**os.environ, **_ONE_THREAD, "PYTHONPATH": _module_folders()},
            start_new_session=True,  # Ctrl-C is for the command
        )
        theirs.close()
        self._process, self._connection = process, ours
        ours.recv()  # it is ready
        if self._is_closed:
            raise OSError("closed")
        return process, ours

    def _stop(self) -> None:
        process, connection = self._process, self._connection
        self._process = self._connection = None
        if process is not None:
            process.kill()
            process.wait()
            if process.stdin is not None:
                process.stdin.close()
        if connection is not None:
            connection.close()

    def interrupt(self) -> None:
        """End the process, and with it the job that runs in another thread; start no other."""
        self._is_closed = True
        if self._process is not None:
            self._process.kill()

    def close(self) -> None:
        """End the process, when no other thread uses it."""
        self.interrupt()
        self._stop()


def _module_folders() -> str:
    """Where the process finds modules: where this one does, not in the folder it is started in."""
    return os.pathsep.join([os.environ.get("PYTHONPATH", ""), *sys.path]).strip(os.pathsep)


def _death(error: str) -> Outcome:
    return Outcome(error_kind="worker died", error=error)


def _how_it_ended(code: int) -> str:
    """An exit code of a process in words."""
    if code >= 0:
        return f"the job's process ended with exit code {code}"
    name = signal.Signals(-code).name
    memory = "; was the memory enough?" if -code == signal.SIGKILL else ""
    return f"the job's process was ended by {name}{memory}"


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
    """The child's side: run what comes through the pipe until it closes."""
    import calibgraph.pipeline  # noqa: F401 - it takes seconds, which are not the first job's
    from calibgraph.fleet.execute import execute

    place: list[Path] = []
    threading.Thread(target=_end_with_parent, args=(place,), daemon=True).start()
    connection = Connection(int(sys.argv[1]))
    connection.send("ready")
    while True:
        try:
            task, folder = connection.recv()
        except EOFError:
            return
        place[:] = [folder]
        with _output_to(folder / _LOG), _memory_limit(task.limits.memory_bytes):
            outcome = execute(task, folder)
        connection.send(outcome)


def _end_with_parent(place: list[Path]) -> None:
    """End this process, and remove what it fetched, when the parent is gone."""
    os.read(0, 1)  # not sys.stdin, whose lock would make the exit of Python fail
    for folder in place:
        shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)


@contextmanager
def _output_to(path: Path) -> Iterator[None]:
    """Send all output into a file, that of compiled libraries too."""
    with path.open("ab") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    try:
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()


@contextmanager
def _memory_limit(most: int | None) -> Iterator[None]:
    """Let allocations beyond this number of bytes fail, where the system can."""
    import resource

    before = resource.getrlimit(resource.RLIMIT_DATA)
    if most is not None:
        resource.setrlimit(resource.RLIMIT_DATA, (most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


if __name__ == "__main__":
    with suppress(BrokenPipeError, ConnectionResetError):  # the parent has gone
        main()
