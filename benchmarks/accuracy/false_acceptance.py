r"""The search of `structure` with nothing to find: images with the clouds of other places.

    calibgraph simulate street --vary-layout --rig sample --frames 3 --seed 1 \
        --out out/scenes/scene_1   # ...
    python -m benchmarks.accuracy.false_acceptance --scenes out/scenes --whole
    python -m benchmarks.accuracy.false_acceptance --recordings

Guesses are drawn uniformly within 20 deg and 1.5 m per axis. A camera that the search accepts all
the same is accepted falsely; the rate that acceptance is built for stands beside it. ``--whole``
calibrates such a rig to the end: what the verdict of its accepted cameras is.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.accuracy import ledger
from benchmarks.accuracy.ledger import Key, Record
from benchmarks.accuracy.scenes import OTHER, Folders, with_images
from benchmarks.tables import Table
from calibgraph import Dataset, StructureMatcher, calibrate, perturb
from calibgraph.matching.structure.acceptance import FALSE_ACCEPTANCE
from calibgraph.progress import no_progress

WITHIN_DEG, WITHIN_M = 20.0, 1.5
SEQUENCES = tuple(name for name in OTHER if "+" not in name)


def main() -> None:
    """Run cases, print the table."""
    parser = ledger.case_parser(__doc__, "false_acceptance")
    parser.add_argument("--scenes", type=Path, help="folder of rendered scenes, scene_N each")
    parser.add_argument("--recordings", action="store_true", help="KITTI's sequences")
    parser.add_argument("--starts", type=int, default=5, help="other clouds and guesses per scene")
    parser.add_argument("--first", type=int, default=0, help="seed of the first")
    parser.add_argument("--whole", action="store_true", help="calibrate where one is accepted")
    arguments = parser.parse_args()
    folders = Folders(arguments.realdata, arguments.scenes)
    cases = [
        Key("wrong clouds", kind, data, seed)
        for seed in range(arguments.first, arguments.first + arguments.starts)
        for kind, data in _sources(arguments, folders, seed)
    ]
    work = partial(run_case, folders=folders, whole=arguments.whole)
    records = ledger.records_of(arguments, cases, work)
    ledger.publish_cases([report(records)], records)


def _sources(arguments: argparse.Namespace, folders: Folders, seed: int) -> list[tuple[str, str]]:
    """(kind, images/clouds): every scene's images with another one's clouds."""
    found = []
    if arguments.scenes is not None:
        names = sorted(path.name for path in arguments.scenes.glob("scene_*"))
        step = 1 + seed % (len(names) - 1)
        others = names[step:] + names[:step]
        found += [("rendered", f"{a}/{b}") for a, b in zip(names, others, strict=True)]
    if arguments.recordings:
        found += [("recorded", f"{name}/{OTHER[name]}") for name in SEQUENCES]
    return found


def run_case(case: Key, folders: Folders, *, whole: bool) -> Record:
    """Search for the cameras of one scene in the clouds of another; calibrate if one is found."""
    images, clouds = case.data.split("/")
    data, truth = folders.load(images)
    wrong = _with_clouds_of(data, folders.load(clouds)[0])
    guess = perturb(
        truth, rotation_deg=WITHIN_DEG, translation_m=WITHIN_M, seed=case.seed, uniform=True
    )
    matcher = StructureMatcher(seed=case.seed)
    start = matcher.locate(wrong, guess, out_of_time=lambda: False, progress=no_progress)
    found = dict(start.findings.found)
    record: Record = {"found": found, "missed": dict(start.findings.missed)}
    if found and whole:
        result = calibrate(wrong, guess, StructureMatcher(seed=case.seed))
        record |= ledger.to_record(result, truth)
    return record


def _with_clouds_of(data: Dataset, other: Dataset) -> Dataset:
    """As many frames as both have."""
    count = min(len(data.frames), len(other.frames))
    clouds = replace(other, frames=other.frames[:count])
    return with_images(clouds, lambda index, _: data.frames[index].image_paths)


def report(records: list[Record]) -> Table:
    """A row per kind of data."""
    rows = []
    for kind in sorted({record["kind"] for record in records}):
        done = [r for r in records if r["kind"] == kind and "found" in r]
        accepted = [z for r in done for z in r["found"].values()]
        z_scores = accepted + [z for r in done for z in r["missed"].values()]
        seconds = [r["seconds"] for r in done if "cameras" not in r]
        verdicts = Counter(
            r["cameras"][name]["status"] for r in done if "cameras" in r for name in r["found"]
        )
        rows.append(
            (
                kind, str(len(done)), str(len(z_scores)), str(len(accepted)),
                f"{len(z_scores) * FALSE_ACCEPTANCE:.2f}", f"{np.median(z_scores):.1f}",
                f"{max(z_scores):.1f}", f"{np.median(seconds):.0f}",
                ", ".join(f"{verdicts[status]} {status}" for status in sorted(verdicts)) or "-",
            )
        )  # fmt: skip
    columns = (
        "data", "searches", "cameras", "accepted", "expected", "best z-score, median", "highest",
        "time, median [s]", "accepted, by the verdict",
    )  # fmt: skip
    return Table("Images with clouds of other places", columns, tuple(rows))


if __name__ == "__main__":
    main()
