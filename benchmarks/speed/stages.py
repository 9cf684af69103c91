"""Where the time of a calibration goes: wall and processor seconds per stage, and peak memory.

    python -m benchmarks.speed.stages DATASET       # calibrate with all frames, and report

The command `calibgraph calibrate` runs in this process, from its imports to the written report.
Nothing of the measured program is changed. A thread looks every few milliseconds at the stacks of
the others, and at their processor clocks. The processor time of the whole process since the last
look, which includes threads of libraries, is divided among the stages of the threads in proportion
to their own clocks; so is the wall time, of which a stage that runs beside others has its share.
"""

from __future__ import annotations

import contextlib
import gc
import resource
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import FrameType, TracebackType

import numpy as np

from benchmarks.tables import Table, parser_of, publish

INTERVAL_S = 0.005
_ALONE_S = 10.0  # far longer than a sample takes

OTHER = "other"
_INNER = (
    ("import", ("importlib._bootstrap",)),
    ("compile", ("/numba/",)),
    ("decode", ("/calibgraph/io/", "/prepared_cloud.py", "/frame_cache.py")),
    ("windows", ("/structure/window", "/structure/directions.py",
                 "/structure/visibility.py")),
    ("score", ("/structure/shift_scores.py", "/structure/score", ":_score_maps")),
    ("consensus", ("/structure/consensus.py",)),
    ("search", ("/structure/correlation", "/structure/box_search.py",
                "/structure/common_features.py", "/structure/bodies.py")),
    ("pairs", ("/matching/camera_pairs/",)),
    ("solve", ("/calibgraph/solver/", "/factors/")),
)  # fmt: skip
_OUTER = (
    ("checks", ("/calibgraph/trust/",)),
    ("report", ("/calibgraph/report/", ":_write_result")),
)
_ALWAYS = ("import", "compile")
WORK = (
    "decode", "windows", "score", "consensus", "search", "pairs", "solve", "checks", "report",
)  # fmt: skip
STAGES = (*_ALWAYS, *WORK, OTHER)
"""In the order of a calibration. A stage is where the innermost function of a thread's stack that
belongs to one is; but all that the checks or the report call is theirs."""


class StageSampler:
    """Samples the stages of the process: ``with StageSampler() as sampler: ...``.

    Attributes:
        wall_s, cpu_s: seconds by stage; the sums are those of the body.
    """

    def __init__(self) -> None:
        self.wall_s = dict.fromkeys(STAGES, 0.0)
        self.cpu_s = dict.fromkeys(STAGES, 0.0)
        self._stop = threading.Event()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._main = threading.get_ident()
        self._clocks: dict[int, float] = {}
        self._last = time.perf_counter(), time.process_time()

    def __enter__(self) -> StageSampler:
        """Start sampling."""
        self._clocks = dict(_thread_clocks())
        self._last = time.perf_counter(), time.process_time()
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop sampling."""
        self._stop.set()
        self._thread.join()
        if self._error is not None and kind is None:
            problem = f"the sampler failed ({self._error!r}); the times are not whole"
            raise RuntimeError(problem) from self._error

    def _run(self) -> None:
        try:
            while not self._stop.wait(INTERVAL_S):
                self._sample()
            self._sample()
        except Exception as error:  # noqa: BLE001 - of any kind: raised at the end
            self._error = error

    def _sample(self) -> None:
        """Add the time since the last sample to the stages that used it."""
        stages = _stages_of_threads()
        clocks = dict(_thread_clocks())
        used = {key: max(0.0, clocks[key] - self._clocks.get(key, 0.0)) for key in clocks}
        del used[threading.get_ident()]
        now = time.perf_counter(), time.process_time()
        wall_s, cpu_s = np.subtract(now, self._last)
        self._clocks, self._last = clocks, now
        total = sum(used.values())
        shares = {ident: part / total for ident, part in used.items()} if total > 0 else {}
        for ident, share in (shares or {self._main: 1.0}).items():
            stage = stages.get(ident, OTHER)
            self.wall_s[stage] += share * float(wall_s)
            self.cpu_s[stage] += share * float(cpu_s)


def _stages_of_threads() -> dict[int, str]:
    """The stage of every Python thread, by its identifier.

    No other thread runs meanwhile, and nothing is collected: a collection can stop all threads for
    good (CPython's issue 106883), and stacks that change while they are walked end the process.
    """
    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(_ALONE_S)
    gc.disable()
    try:
        return {ident: stage_of(frame) for ident, frame in sys._current_frames().items()}
    finally:
        gc.enable()
        sys.setswitchinterval(interval_s)


def _thread_clocks() -> Iterator[tuple[int, float]]:
    """Processor seconds of every Python thread, by its identifier."""
    for thread in threading.enumerate():
        if thread.native_id is None or thread.ident is None:
            continue
        try:  # Linux' number of a thread's clock; pthread_getcpuclockid is unsafe for ended threads
            yield thread.ident, time.clock_gettime((~thread.native_id << 3) | 6)
        except OSError:  # it has ended
            continue


def stage_of(frame: FrameType | None) -> str:
    """The stage of a stack, given its innermost frame."""
    found = OTHER
    while frame is not None:
        inner, outer = _stages_of(frame.f_code.co_filename, frame.f_code.co_name)
        found = inner if found == OTHER else found
        if found in _ALWAYS:
            return found
        if outer != OTHER:
            return outer
        frame = frame.f_back
    return found


@cache
def _stages_of(file: str, function: str) -> tuple[str, str]:
    """The stage of a function by ``_INNER`` and by ``_OUTER``."""
    place = f"{file}:{function}"
    inner, outer = (
        [stage for stage, parts in stages if any(part in place for part in parts)]
        for stages in (_INNER, _OUTER)
    )
    return [*inner, OTHER][0], [*outer, OTHER][0]


def _calibrate(dataset: Path, out: str) -> None:
    from calibgraph.cli.app import main as calibgraph

    sys.argv = ["calibgraph", "calibrate", str(dataset), "--frames", ":", "--out", out]
    try:
        calibgraph()
    except SystemExit as end:
        if end.code not in (0, 1):  # 1: the verdict is FAIL
            raise


def main() -> None:
    """Calibrate in this process, and print the stages; errors of the command end it."""
    parser = parser_of(__doc__)
    parser.add_argument("dataset", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as out:
        with StageSampler() as sampler, contextlib.redirect_stdout(sys.stderr):
            _calibrate(options.dataset, out)
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        from calibgraph import load_calibration

        verdict = load_calibration(out).verdict.status
    both = sampler.wall_s, sampler.cpu_s
    wall_s, cpu_s = ({**seconds, "all": sum(seconds.values())} for seconds in both)
    rows = [
        (stage, f"{wall_s[stage]:.2f}", f"{used:.2f}", f"{used / cpu_s['all']:.0%}")
        for stage, used in cpu_s.items()
    ]
    table = Table(f"{verdict}, {peak_mb:.0f} MB at most", ("stage", "wall [s]", "CPU [s]", "share"),
                  tuple(rows))  # fmt: skip
    publish("speed.stages", [table], record=options.record)


if __name__ == "__main__":
    main()
