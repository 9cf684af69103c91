"""Verdicts of rendered drives from images: five streets of one sensor together, and one alone.

    python -m benchmarks.accuracy.street_verdicts --groups 116:163 --scenes out/error_bars

Groups are those of ``error_bars``, whose streets must have been rendered: five of a rig whose
sensors err, three frames each. Per group ``calibrate`` gets all five, from a guess 2 degrees and
0.2 m off; the same, made wrong in one of the ways of ``verdicts``, in turn; and one more street of
six frames, rendered when it is needed. Groups 100 to 115 are to choose by, others are kept out.
A result is right within 0.3 degrees and 7 cm of its alignment, and off beyond 0.5 degrees or 10 cm.
"""

import tempfile
from collections import Counter
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.accuracy import ledger
from benchmarks.accuracy.cases import DATA
from benchmarks.accuracy.error_bars import STREETS, group_parser, render_street, seeds_of
from benchmarks.accuracy.ledger import Key, Record
from benchmarks.accuracy.scenes import Folders, Scene
from benchmarks.accuracy.verdicts import CLASSES, STATUSES, class_of
from benchmarks.tables import Table
from calibgraph import calibrate, load_dataset
from tools.scenes.sensor_streets import RIGS, mean_poses

LONGER, CLOSER_M = 6, 1.5  # frames of the street that is alone, and their distance
_ALONE = 300_000  # seeds of such streets
RIGHT = (0.3, 7.0)  # deg, cm
GOOD, ONE = "good", "good, one place"
WRONG = (
    "focal_5", "shuffled", "principal", "mirrored", "focal_3", "moved_halfway", "sheared",
    "swapped_unknown", "focal_y", "shifted", "half_resolution", "frozen",
)  # fmt: skip
KINDS_IN_ORDER = (GOOD, ONE, *WRONG)


def main() -> None:
    """Run cases, print the tables."""
    options = group_parser(__doc__, "street_verdicts", [116, 163]).parse_args()
    cases = [
        Key("streets", kind, f"{options.size:g}", group)
        for group in range(*options.groups)
        for kind in (GOOD, ONE, WRONG[group % len(WRONG)])
    ]
    records = ledger.records_of(options, cases, partial(run_case, scenes=options.scenes))
    ledger.publish_cases([report(records)], records)


def run_case(case: Key, scenes: Path) -> Record:
    """Join the streets of a group, spoil them, calibrate."""
    group, rendered = case.seed, partial(render_street, size=float(case.data))
    if case.kind == ONE:
        folders = [scenes / f"scene_{_ALONE + group}"]
        rigs = [rendered(folders[0], group, _ALONE + group, frames=LONGER, step_m=CLOSER_M)]
    else:
        seeds = seeds_of(group, STREETS)
        folders = [scenes / f"scene_{seed}" for seed in seeds]
        rigs = [rendered(*each) for each in zip(folders, [group] * STREETS, seeds, strict=True)]
    stated = rigs[0][0]
    truth = stated.moved_to(mean_poses([aligned.T_camera_lidar for _, aligned in rigs]))
    spoil = DATA[GOOD if case.kind == ONE else case.kind]
    with tempfile.TemporaryDirectory() as scratch:
        name, data = RIGS[group % len(RIGS)][0], load_dataset(folders, stated)
        scene = Scene(name, data, stated, Folders(None, None), Path(scratch), group)
        spoilt, guess, drawn = spoil(scene, np.random.default_rng([17, group]))
        result = calibrate(spoilt, guess)
    found = ledger.to_record(result, truth)
    return {"drawn": drawn, "places": len(result.places), **found}


def report(records: Sequence[Record]) -> Table:
    """A row per kind, and one of all that were made wrong."""
    groups: dict[str, list[Record]] = {}
    for record in sorted(records, key=lambda one: KINDS_IN_ORDER.index(one["kind"])):
        groups.setdefault(record["kind"], []).append(record)
    rows = [_cells(kind, of_kind) for kind, of_kind in groups.items()]
    rows.append(_cells("made wrong", [one for one in records if one["kind"] in WRONG]))
    heads = (f"{which}: {status}" for which in CLASSES for status in STATUSES)
    return Table(
        "Verdicts of five streets together, and of one",
        ("", "drives", "refused", "places, median", "error, median [deg]", "[cm]", *heads),
        tuple(rows),
    )


def _cells(name: str, records: Sequence[Record]) -> tuple[str, ...]:
    done = [record for record in records if "cameras" in record]
    cameras = [camera for record in done for camera in record["cameras"].values()]
    found = Counter((class_of(camera, RIGHT), camera["status"]) for camera in cameras)
    sizes = [_median(camera[f"error_{unit}"] for camera in cameras) for unit in ("deg", "cm")]
    refused = sum("refusal" in record for record in records)
    counts = [str(found[which, status]) for which in CLASSES for status in STATUSES]
    places = _median(record["places"] for record in done)
    errors = (f"{v:.2f}" for v in sizes)
    return (name, str(len(records)), str(refused), f"{places:g}", *errors, *counts)


def _median(values: Iterable[float]) -> float:
    return float(np.median([*values] or [np.nan]))


if __name__ == "__main__":
    main()
