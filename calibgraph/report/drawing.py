"""Diagrams drawn here, or in processes that load Matplotlib while a calibration works."""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from itertools import islice

from calibgraph.child_process import (
    ChildEndedError,
    ChildProcess,
    ChildTimeoutError,
    Note,
    answer_requests,
)
from calibgraph.errors import CalibrationError
from calibgraph.parallel import count_cores

Diagrams = Mapping[str, "partial[str]"]
"""By name, the call that draws a diagram as a data URI."""
Drawn = dict[str, str]
Draw = Callable[[Diagrams], Callable[[], Drawn]]
"""Begins to draw diagrams; its result waits for them."""

_MOST_PROCESSES = 3  # each takes 60 MB
_TIMEOUT_S = 600.0

_log = logging.getLogger(__name__)


def draw(diagrams: Diagrams) -> Drawn:
    """Draw diagrams in this process."""
    return {name: diagram() for name, diagram in diagrams.items()}


def draw_here(diagrams: Diagrams) -> Callable[[], Drawn]:
    """Draw diagrams in this process when they are asked for."""
    return partial(draw, diagrams)


@contextmanager
def drawing_processes() -> Iterator[Draw]:
    """Start a process per core that draws its share of each camera; with one core, draw here.

    They end with the body of the ``with``, and with this process.
    """
    count = min(_MOST_PROCESSES, count_cores())
    if count == 1:
        yield draw_here
        return
    with ExitStack() as stack:
        processes = [stack.enter_context(closing(DrawingProcess())) for _ in range(count)]

        def begin(diagrams: Diagrams) -> Callable[[], Drawn]:
            shares = [dict(islice(diagrams.items(), i, None, count)) for i in range(count)]
            waiting = [process.begin(each) for process, each in zip(processes, shares, strict=True)]
            return lambda: {name: uri for wait in waiting for name, uri in wait().items()}

        yield begin


class DrawingProcess:
    """A process that draws diagrams while this one does other things."""

    def __init__(self) -> None:
        self._child = ChildProcess(__name__)
        self._thread = ThreadPoolExecutor(1)
        self._is_ready: Future[bool] = self._thread.submit(self._start)

    def _start(self) -> bool:
        """Whether it could be started; else the diagrams are drawn here."""
        try:
            self._child.start()
        except ChildEndedError as error:
            _log.warning("the diagrams are drawn in this process: %s", error)
            return False
        return True

    def begin(self, diagrams: Diagrams) -> Callable[[], Drawn]:
        """Begin to draw; the result waits for the diagrams.

        Raises, where it waits:
            CalibrationError: if the process ends, or takes longer than ten minutes.
        """
        return self._thread.submit(self._ask, diagrams).result

    def _ask(self, diagrams: Diagrams) -> Drawn:
        if not self._is_ready.result():
            return draw(diagrams)
        try:
            answer: Drawn | Exception = self._child.ask(diagrams, _TIMEOUT_S)
        except (ChildEndedError, ChildTimeoutError) as error:
            raise CalibrationError(f"the diagrams of the report cannot be drawn: {error}") from None
        if isinstance(answer, Exception):
            raise answer
        return answer

    def close(self) -> None:
        """End the process, and wait for it."""
        self._child.interrupt()
        self._thread.shutdown(cancel_futures=True)
        self._child.close()


def _answer(diagrams: Diagrams, _: Note) -> Drawn | Exception:
    try:
        return draw(diagrams)
    except Exception as error:
        return error


def main() -> None:
    """The child's side."""
    gc.disable()  # nothing of what is loaded is garbage
    from calibgraph.report.figure import new_figure, to_data_uri

    figure = new_figure(1.0)
    figure.add_axes((0.2, 0.2, 0.7, 0.7))
    to_data_uri(figure)  # loads what the first diagram would wait for: half a second
    gc.freeze()
    gc.enable()
    answer_requests(_answer)


if __name__ == "__main__":
    main()
