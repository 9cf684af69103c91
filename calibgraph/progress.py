"""Progress callbacks, and the wall time of named stages."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Progress = Callable[[str, int, int], None]
"""Called with the name of a task, the steps of it that are done, and their number."""


def no_progress(task: str, done: int, total: int) -> None:
    """No-op progress callback."""


class Stopwatch:
    """Wall time of named stages: ``with watch("stage"): ...``."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Add the wall time of the body to a stage's."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start
