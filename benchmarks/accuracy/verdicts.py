r"""False PASS and false FAIL: cases that are wrong in many ways, and good ones.

    python -m benchmarks.accuracy.verdicts --set tune --tables 20 --data 8 --out out/tune.jsonl
    python -m benchmarks.accuracy.verdicts --summary out/tune.jsonl

Thresholds are chosen on the set ``tune``; what is published is counted on ``count``, which shares
neither recordings (but for the motorway), scenes nor seeds with it. ``--tables`` and ``--data`` are
the cases per kind, of simulated correspondences and of images and clouds: from there on
(``--first``) they go through the rigs, and through the set's sequences and scenes, in turn. A
stopped run continues with the same command. Scenes are simulated beforehand, 20 s each:

    for i in 0 1 2 3 4 5; do
        calibgraph simulate street --rig sample --beams 32 --frames 8 --step-m 5 \
            --seed $((100 + i)) --out out/scenes/scene_$i; done

A result is off beyond 0.5 deg or 10 cm, and right within 0.15 deg and 4 cm, of ``evaluate``'s E_R
and E_t of that camera. Refusals (too few correspondences, say) have no error: they are a column of
their own, never a PASS, and a false alarm if nothing was wrong.
"""

import argparse
import re
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import astuple
from functools import partial
from pathlib import Path

from benchmarks.accuracy import ledger
from benchmarks.accuracy.cases import (
    DATA,
    TABLES,
    UNDETECTABLE,
    data_for,
    data_problem,
    rig_for,
    table_problem,
)
from benchmarks.accuracy.ledger import Key, Record
from benchmarks.accuracy.scenes import MOTORWAY, Folders
from benchmarks.tables import ROOT, Table

SCENES = ROOT / "out" / "scenes"
OFF_DEG, OFF_CM = 0.5, 10.0
RIGHT_DEG, RIGHT_CM = 0.15, 4.0
FIRST_SEED = {"tune": 0, "count": 1000}
STATUSES = ("PASS", "WARN", "FAIL")
CLASSES = ("off", "between", "right")


def main() -> None:
    """Run cases, print the summary."""
    options = parse_options()
    there = (path if path.is_dir() else None for path in (options.realdata, options.scenes))
    folders = Folders(*there)
    cases = [case for case in cases_of(options, folders) if case.kind in options.kinds]
    records = ledger.records_of(options, cases, partial(run_case, folders=folders))
    counted = [record for record in records if record["kind"] not in UNDETECTABLE]
    tables = [summary(records, counted), figures(counted)]
    ledger.publish_cases(tables, records)
    print("\n".join(remarks(counted)))


def parse_options() -> argparse.Namespace:
    """The options."""
    known, parser = sorted({*TABLES, *DATA}), ledger.case_parser(__doc__, "verdicts")
    names: Callable[[str], tuple[str, ...]] = lambda text: tuple(text.split(","))  # noqa: E731
    add = parser.add_argument
    add("--set", choices=FIRST_SEED, default="tune")
    add("--tables", type=int, default=0, help="cases per kind of table")
    add("--data", type=int, default=0, help="cases per kind of images and clouds")
    add("--first", type=int, default=0, help="number of the first case of a kind")
    add("--kinds", type=names, default=known, help=", ".join(known))
    add("--scenes", type=Path, default=SCENES, help="folder of scene_0, ...")
    arguments = parser.parse_args()
    unknown = {*arguments.kinds} - {*known}
    if unknown:
        parser.error(f"unknown kinds {', '.join(sorted(unknown))}; known: {', '.join(known)}")
    return arguments


def cases_of(arguments: argparse.Namespace, folders: Folders) -> Iterator[Key]:
    """The cases of a set: number by number, so that a stopped run has some of every kind."""
    first = FIRST_SEED[arguments.set] + arguments.first
    names = folders.names(arguments.set)
    for seed in range(first, first + max(arguments.tables, arguments.data)):
        if seed < first + arguments.tables:
            for kind in TABLES:
                yield Key("table", kind, rig_for(kind, seed), seed)
        if seed < first + arguments.data:
            for kind in DATA:
                name = data_for(kind, names, seed)
                missing = name is None or (name == MOTORWAY and not folders.realdata)
                if not missing:
                    yield Key("data", kind, name, seed)


def run_case(case: Key, folders: Folders) -> Record:
    """Make one case, run calibgraph on it, and compare."""
    with tempfile.TemporaryDirectory() as scratch:
        if case.level == "table":
            problem = table_problem(case.kind, case.data, case.seed)
        else:
            problem = data_problem(case.kind, case.data, case.seed, folders, Path(scratch))
        return {"drawn": problem.drawn, **ledger.to_record(problem.calibrate(), problem.truth)}


def class_of(camera: Record, right: tuple[float, float] = (RIGHT_DEG, RIGHT_CM)) -> str:
    """How wrong one camera's result is, if it is right within these [deg, cm]."""
    deg, cm = camera["error_deg"], camera["error_cm"]
    if not (deg <= OFF_DEG and cm <= OFF_CM):
        return "off"  # also NaN
    return "right" if deg <= right[0] and cm <= right[1] else "between"


def cameras_of(records: Iterable[Record]) -> Iterator[tuple[str, str]]:
    """Class and status of every result."""
    for record in records:
        for camera in record.get("cameras", {}).values():
            yield class_of(camera), camera["status"]


COLUMNS = (
    "", "cases", "refused", "results",
    *(f"{which}: {status}" for which in CLASSES for status in STATUSES),
)  # fmt: skip


def summary(records: list[Record], counted: list[Record]) -> Table:
    """A row per kind, and the sums of those that count."""
    groups: dict[tuple[str, str], list[Record]] = {}
    for record in sorted(records, key=_order):
        groups.setdefault((record["level"], record["kind"]), []).append(record)
    rows = [cells(f"{level} {kind}", group) for (level, kind), group in groups.items()]
    left_out = sorted({r["kind"] for r in records} - {r["kind"] for r in counted})
    total = "all" + (f", without {', '.join(left_out)}" if left_out else "")
    return Table("Verdicts of results by their error", COLUMNS, (*rows, cells(total, counted)))


def cells(name: str, group: list[Record]) -> tuple[str, ...]:
    """The row of one kind."""
    found = Counter(cameras_of(group))
    refused = sum("refusal" in record for record in group)
    counts = (found[which, status] for which in CLASSES for status in STATUSES)
    return name, *map(str, (len(group), refused, found.total(), *counts))


def _order(record: Record) -> tuple[str, int]:
    kinds = [*(TABLES if record["level"] == "table" else DATA)]
    return record["level"], kinds.index(record["kind"])


def figures(counted: list[Record]) -> Table:
    """The share of PASS among results that are off, and of FAIL among those that are right."""
    found = Counter(cameras_of(counted))
    off, right = (sum(found[which, s] for s in STATUSES) for which in ("off", "right"))
    wrong_cases = [r for r in counted if any(which == "off" for which, _ in cameras_of([r]))]
    refused_good = sum("refusal" in r for r in counted if r["kind"] == "good")
    calm = found["right", "PASS"] + found["right", "WARN"]
    off_by = f"off by more than {OFF_DEG} deg or {OFF_CM:g} cm"
    within = f"within {RIGHT_DEG} deg and {RIGHT_CM:g} cm and good cases that were refused"
    rows = [
        (f"PASS, of results {off_by}", share(found["off", "PASS"], off)),
        (f"PASS, of cases with a result {off_by}", share(len(_passed(counted)), len(wrong_cases))),
        (f"PASS or WARN, of results {within}", share(calm, right + refused_good)),
    ]
    for which in ("off", "right"):
        cameras = [c for r in counted for c in r.get("cameras", {}).values()]
        warned = [c.get("cannot_tell", False) for c in cameras
                  if (class_of(c), c["status"]) == (which, "WARN")]  # fmt: skip
        what = f"cannot_tell, of WARN of results that are {which}"
        rows.append((what, share(sum(warned), len(warned))))
    return Table("Wrong verdicts", ("", "share"), tuple(rows))


def remarks(counted: list[Record]) -> Iterator[str]:
    """Cases that PASS although off, and reasons of refusals."""
    for record in _passed(counted):
        wrong = {
            name: f"{camera['error_deg']:.2f} deg {camera['error_cm']:.1f} cm"
            for name, camera in record["cameras"].items()
            if class_of(camera) == "off" and camera["status"] == "PASS"
        }
        yield f"PASS but off: {' '.join(map(str, astuple(ledger.key_of(record))))}: {wrong}"
    refusals = Counter(
        f"{r['level']} {r['kind']} {re.sub(r'[0-9.]+', '#', r['refusal'])[:120]}"
        for r in counted if "refusal" in r
    )  # fmt: skip
    yield from (f"refused, {count}: {what}" for what, count in refusals.items())


def _passed(counted: list[Record]) -> list[Record]:
    """Cases with a camera that PASSes although off."""
    return [r for r in counted if ("off", "PASS") in {*cameras_of([r])}]


def share(part: int, whole: int) -> str:
    """A part with its share."""
    return f"{part} of {whole}" + (f" ({part / whole:.1%})" if whole else "")


if __name__ == "__main__":
    main()
