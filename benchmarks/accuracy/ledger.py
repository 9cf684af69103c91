"""Cases that run in processes, a line of JSON each in a file: a stopped run continues from there.

A line holds a hash of the code that made it (``code``). Lines of other code are kept and counted.
"""

import argparse
import hashlib
import json
import os
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import calibgraph
import factors
from benchmarks.tables import ROOT, Table, parser_of, publish
from calibgraph import Calibration, CalibrationError, Rig, evaluate
from calibgraph.model.geometry import twist_between

REALDATA = Path(os.environ.get("CALIBGRAPH_REALDATA", ROOT.parent / "shared" / "realdata"))
"""The real sensor data: $CALIBGRAPH_REALDATA, or a folder beside the checkout."""


@dataclass(frozen=True)
class Key:
    """What identifies a case."""

    level: str
    kind: str
    data: str
    seed: int


Record = dict[str, Any]


@cache
def code() -> str:
    """A hash of the packages' sources."""
    packages = [Path(package.__file__ or "").parent for package in (calibgraph, factors)]
    sources = [path for package in packages for path in sorted(package.rglob("*.py"))]
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:12]


def read(path: Path) -> list[Record]:
    """The newest line of every case in a file; none if there is no file."""
    lines = path.read_text("utf-8").splitlines(keepends=True) if path.is_file() else []
    records = [json.loads(line) for line in lines if line.endswith("\n")]
    return list({key_of(record): record for record in records}.values())


def key_of(record: Record) -> Key:
    """The case of a line."""
    return Key(*(record[name] for name in Key.__dataclass_fields__))


def case_parser(description: str | None, name: str) -> argparse.ArgumentParser:
    """The options of a benchmark whose cases are in a file of this name."""
    parser = parser_of(description)
    add = parser.add_argument
    add("--jobs", type=int, default=1, help="processes; 1 to measure time")
    add("--realdata", type=Path, default=REALDATA, help="folder of the recordings")
    add("--out", type=Path, default=ROOT / "out" / f"{name}.jsonl", help="a line per case")
    add("--summary", type=Path, help="print the tables of a file, run nothing")
    return parser


def records_of(
    arguments: argparse.Namespace, cases: Iterable[Key], work: Callable[[Key], Record]
) -> list[Record]:
    """The cases of the file ``--summary`` if it is given, else of a :func:`run`."""
    if arguments.summary is not None:
        return read(arguments.summary)
    return run(cases, work, out=arguments.out, jobs=arguments.jobs)


def publish_cases(tables: Sequence[Table], records: Sequence[Record]) -> None:
    """Print tables of cases, crashes, and how many cases other code has run."""
    publish(tables)
    crashes = Counter(one["crash"].strip().splitlines()[-1] for one in records if "crash" in one)
    for what, count in crashes.items():
        print(f"CRASHED, {count}: {what}")
    others = sum(one.get("code") != code() for one in records)
    if others:
        print(f"\n{others} of {len(records)} cases were run by other code")


def run(
    cases: Iterable[Key], work: Callable[[Key], Record], *, out: Path, jobs: int
) -> list[Record]:
    """Run the cases that the file does not have yet (or that crashed); return all its cases.

    Args:
        cases: what to run.
        work: runs one case in a process of the pool; see :func:`run_case`.
        out: the file, to which a line is appended as soon as its case is done.
        jobs: processes.
    """
    kept = [record for record in read(out) if "crash" not in record]
    done = {key_of(record) for record in kept}
    left = [case for case in cases if case not in done]
    others = sum(record.get("code") != code() for record in kept)
    of_others = f", {others} of them by other code" if others else ""
    print(f"{len(left)} cases to run, {len(done)} in {out}{of_others}", flush=True)
    out.parent.mkdir(parents=True, exist_ok=True)
    _drop_incomplete_line(out)
    start, pool = time.perf_counter(), ProcessPoolExecutor(jobs)
    try:
        tasks = [pool.submit(run_case, work, case) for case in left]
        for count, task in enumerate(as_completed(tasks), start=1):
            with out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(task.result()) + "\n")
            if count % 20 == 0 or count == len(left):
                seconds = time.perf_counter() - start
                print(f"{count} of {len(left)} done, {seconds:.0f} s", flush=True)
    finally:
        pool.shutdown(cancel_futures=True)  # Ctrl-C waits only for the running cases
    return read(out)


def _drop_incomplete_line(out: Path) -> None:
    """Remove an incomplete last line, which a stopped run leaves."""
    if out.is_file():
        data = out.read_bytes()
        out.write_bytes(data[: data.rfind(b"\n") + 1])


def run_case(work: Callable[[Key], Record], case: Key) -> Record:
    """The line of a case: the result of ``work``, or why there is none."""
    cv2.setNumThreads(1)
    start = time.perf_counter()
    try:
        found = work(case)
    except CalibrationError as error:
        found = {"refusal": f"{type(error).__name__}: {error}"}
    except Exception:  # noqa: BLE001 - a fault of the program, to be seen in the summary
        found = {"crash": traceback.format_exc()}
    seconds = round(time.perf_counter() - start, 3)
    return {**asdict(case), "code": code(), "seconds": seconds, **found}


def to_record(result: Calibration, truth: Rig) -> Record:
    """Per camera: verdict, error bar, and the errors against the truth."""
    errors = evaluate(result.rig, truth).cameras
    return {"cameras": {name: _camera(result, name, truth, errors[name]) for name in errors}}


def _camera(result: Calibration, name: str, truth: Rig, error: Any) -> Record:
    verdict, sigmas, covariance = (
        result.camera_verdicts[name],
        result.sigmas(name),
        result.covariance[name],
    )
    xi = twist_between(result.T_camera_lidar[name], truth.T_camera_lidar[name])
    squared = None if covariance is None else float(xi @ np.linalg.solve(covariance, xi)) / 6
    return {
        "status": verdict.status,
        "cannot_tell": verdict.cannot_tell,
        "reasons": list(verdict.reasons),
        "error_deg": error.rotation_error_deg,
        "error_cm": error.translation_error_cm,
        "xi_deg": np.degrees(xi[:3]).tolist(),
        "xi_cm": (100 * xi[3:]).tolist(),
        "covariance": None if covariance is None else covariance.tolist(),
        "sigma_deg": None if sigmas is None else sigmas[0].tolist(),
        "sigma_cm": None if sigmas is None else sigmas[1].tolist(),
        "normalised_squared": squared,
        "beyond": verdict.error_probability and verdict.error_probability.by_error_bar,
        "checks": [
            [c.kind or c.name, c.status, _number(c.value), c.severity, c.decisive]
            for c in verdict.checks
        ],
    }


def _number(value: Any) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)
