"""A process of its own for requests: a crash, a leak or an endless loop ends it, and nothing else.

It is kept from request to request, because loading the libraries takes longer than a small solve.
It is no process of ``multiprocessing``: workers of Dask may not have such children.
"""

import os
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal

from calibgraph.errors import CalibrationError
from calibgraph.parallel import THREADS_VARIABLE

Process = subprocess.Popen[bytes]
Note = Callable[[Any], None]
"""Called in the child with what the parent is to get before the answer."""

_ONE_THREAD = dict.fromkeys(
    (THREADS_VARIABLE, "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM",
     "NUMBA_NUM_THREADS"), "1",
)  # fmt: skip
"""The requests share the cores, so that each needs one thread only."""

ErrorKind = Literal["bad input", "io", "out of memory", "timeout", "worker died", "internal error"]


@dataclass(frozen=True)
class Outcome:
    """How a job ended: its result, or why it failed, in one line; its time and what it printed."""

    result: Any = None
    error_kind: ErrorKind | None = None
    error: str | None = None
    seconds: float = 0.0
    log: str = ""


def failed(error: Exception, places: Mapping[str, str]) -> Outcome:
    """The outcome of a job that failed: wrong data are no fault of the machine's.

    Args:
        error: of the job.
        places: parts of its text that are of this machine, as paths, and what to read for them.
    """
    kind, text = _describe(error)
    for place, name in places.items():
        text = text.replace(place, name)
    return Outcome(error_kind=kind, error=str(CalibrationError(text)))  # in one line


def _describe(error: Exception) -> tuple[ErrorKind, str]:
    if isinstance(error, MemoryError):
        why = f" ({error})" if str(error) else ""
        return "out of memory", f"not enough memory{why}; give fewer frames, or more --memory-gb"
    if isinstance(error, (CalibrationError, ValueError)):
        return "bad input", str(error)
    traceback.print_exception(error)
    if isinstance(error, OSError):
        return "io", str(error)
    return "internal error", f"{type(error).__name__}: {error}"


class ChildEndedError(Exception):
    """The process ended before its answer, or could not be started; after a timeout by us."""

    def __init__(self, text: str, kind: ErrorKind = "worker died") -> None:
        super().__init__(text)
        self.kind = kind


class ChildProcess:
    """A process of a module that answers one request at a time; started again after its end."""

    def __init__(self, module: str, arguments: Sequence[str] = ()) -> None:
        self._module, self._arguments = module, tuple(arguments)
        self._process: Process | None = None
        self._connection: Connection | None = None
        self._is_closed = False

    def start(self) -> None:
        """Start the process unless it runs, and wait until it is ready."""
        if self._process is not None and self._process.poll() is None and not self._is_closed:
            return
        self.stop()
        try:
            if self._is_closed:
                raise OSError("closed")
            ours, theirs = Pipe()
            # It finds modules where this one does, not in the folder it is started in.
            known = [os.environ.get("PYTHONPATH", ""), *sys.path]
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", self._module, str(theirs.fileno()), *self._arguments],
                stdin=subprocess.PIPE,  # it ends with this process
                stdout=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                env={
                    **os.environ,
                    **_ONE_THREAD,
                    "PYTHONPATH": os.pathsep.join(filter(None, known)),
                },
                start_new_session=True,  # Ctrl-C is for the command
            )
            theirs.close()
            self._process, self._connection = process, ours
            ours.recv()  # it is ready
            if self._is_closed:
                raise OSError("closed")
        except (OSError, EOFError) as error:
            self.stop()
            raise ChildEndedError(f"no process can be started ({error})") from error

    def ask(self, request: Any, timeout_s: float, on_note: Note | None = None) -> Any:
        """The answer of the process that :meth:`start` started.

        Raises:
            ChildEndedError: if the process ends first, or if it takes longer.
        """
        process, connection = self._process, self._connection
        if process is None or connection is None:  # by another thread
            raise ChildEndedError("the process was ended")
        end = time.monotonic() + timeout_s
        try:
            connection.send(request)
            while connection.poll(max(0.0, end - time.monotonic())):
                is_answer, content = connection.recv()
                if is_answer:
                    return content
                if on_note is not None:
                    on_note(content)
        except (EOFError, OSError):
            self.stop()
            raise ChildEndedError(_how_it_ended(process.wait())) from None
        self.stop()
        raise ChildEndedError(f"took over {timeout_s:g} s", "timeout")

    def stop(self) -> None:
        """End the process, when no other thread uses it; the next request starts another."""
        process, connection = self._process, self._connection
        self._process = self._connection = None
        if process is not None:
            process.kill()
            process.wait()
            if process.stdin is not None:
                process.stdin.close()
        if connection is not None:
            connection.close()

    def kill(self) -> None:
        """End the process, and with it the request that another thread waits for."""
        process = self._process
        if process is not None:
            process.kill()

    def interrupt(self) -> None:
        """End the process as :meth:`kill` does, and start no other."""
        self._is_closed = True
        self.kill()

    def close(self) -> None:
        """End the process, when no other thread uses it, and start no other."""
        self.interrupt()
        self.stop()


def _how_it_ended(code: int) -> str:
    """An exit code of a process in words."""
    if code >= 0:
        return f"the job's process ended with exit code {code}"
    name = signal.Signals(-code).name
    memory = "; was the memory enough?" if -code == signal.SIGKILL else ""
    return f"the job's process was ended by {name}{memory}"


def answer_requests(
    answer: Callable[[Any, Note], Any], at_end: Callable[[], None] = lambda: None
) -> None:
    """The child's side: answer what comes through the pipe until it closes.

    Args:
        answer: called with a request, and the function for notes before the answer.
        at_end: called when the parent is gone, in another thread than a request that runs.
    """

    def end_with_parent() -> None:
        os.read(0, 1)  # not sys.stdin, whose lock would make the exit of Python fail
        at_end()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    connection = Connection(int(sys.argv[1]))
    with suppress(BrokenPipeError, ConnectionResetError):  # the parent has gone
        connection.send("ready")
        while True:
            try:
                request = connection.recv()
            except EOFError:
                return
            connection.send((True, answer(request, lambda note: connection.send((False, note)))))


@contextmanager
def output_to(path: Path) -> Iterator[None]:
    """Send all output into a file, from compiled libraries too."""
    with path.open("ab") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    try:
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()


@contextmanager
def memory_limit(most: int | None) -> Iterator[None]:
    """Let allocations beyond this number of bytes fail, where the system can."""
    import resource

    before = resource.getrlimit(resource.RLIMIT_DATA)
    if most is not None:
        resource.setrlimit(resource.RLIMIT_DATA, (most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)
