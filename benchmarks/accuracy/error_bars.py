"""Error bars over many rendered scenes with sensors and lenses that err, each scene once.

    python -m benchmarks.accuracy.error_bars --groups 116:180 --jobs 2
    python -m benchmarks.accuracy.error_bars --groups 116:120 --streets 20

A group is a rig with errors of its own, and five streets that it drove through, three frames each:
one place. Rigs and beams change from group to group; errors of the LiDAR are those of
``tools.scenes.scan_errors``, those of the lenses of half the size. Groups 100 to 115 are to choose
by, 116 to 179 are kept out. The second table solves again with the correspondences of
one, two, five, ten and twenty of a group's streets, as far as it has as many, and has the verdicts
of those tables, without images; the third with those of five, changed: a relative pose is known, a
camera has no matches or few, frames are repeated.
Errors of cameras are of their alignment, those of pairs of their mounts.
NEES is the squared error in the metric of its covariance; its mean over 6 should be 1.
"""

from argparse import ArgumentParser
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import gtsam
import numpy as np

from benchmarks.accuracy import ledger
from benchmarks.accuracy.ledger import Key, Record
from benchmarks.accuracy.uncertainty import calibration
from benchmarks.accuracy.verdicts import STATUSES, class_of
from benchmarks.tables import ROOT, Table
from calibgraph import (
    Calibration,
    Config,
    Correspondences,
    RelativePose,
    Rig,
    calibrate,
    load_camera_matches,
    load_correspondences,
    load_dataset,
    load_rig,
    perturb,
)
from calibgraph.model.camera_matches import CameraMatches, concatenate_camera_matches
from calibgraph.model.correspondences import concatenate
from calibgraph.model.findings import error_components
from calibgraph.model.geometry import relative_covariance, relative_transform, twist_between
from calibgraph.pipeline import to_calibration
from calibgraph.solver.joint import solve_joint
from calibgraph.trust.assess import assess
from calibgraph.trust.evidence import Evidence
from tools.scenes.lens_errors import draw_lens_errors
from tools.scenes.scan_errors import draw_scan_errors
from tools.scenes.sensor_streets import ALIGNMENT, RIGS, aligned_rig, mean_poses, render

STREETS = 5
_FURTHER = 100_000  # seeds of more streets than that
STEP_M = 4.0
GUESS_DEG, GUESS_M = 1.0, 0.1
FRAMES = 3  # of a street


def main() -> None:
    """Render, calibrate, keep a line of each."""
    parser = group_parser(__doc__, "error_bars", [100, 180])
    parser.add_argument("--streets", type=int, default=STREETS, help="of each sensor")
    arguments = parser.parse_args()
    first, last = arguments.groups
    cases = [
        Key("scene", RIGS[group % len(RIGS)][0], f"{arguments.size:g}", seed)
        for group in range(first, last)
        for seed in seeds_of(group, arguments.streets)
    ]
    work = partial(run_case, scenes=arguments.scenes)
    records = ledger.records_of(arguments, cases, work)
    tables = [report(records), *report_together(records, arguments.scenes)]
    ledger.publish_cases(tables, records)


def group_parser(description: str | None, name: str, groups: list[int]) -> ArgumentParser:
    """The options of benchmarks whose cases are groups of rendered streets."""
    parser = ledger.case_parser(description, name)
    parser.add_argument("--scenes", type=Path, default=ROOT / "out" / "error_bars")
    parser.add_argument(
        "--groups", type=lambda text: [int(n) for n in text.split(":")], default=groups
    )
    parser.add_argument("--size", type=float, default=2.0, help="of the errors; one folder each")
    return parser


def seeds_of(group: int, streets: int) -> list[int]:
    """The seeds of a group's streets: five in a row, and further ones."""
    first = [2000 + STREETS * group + street for street in range(min(streets, STREETS))]
    return first + [_FURTHER + 100 * group + street for street in range(STREETS, streets)]


def group_of(seed: int) -> int:
    """The group that a street is of."""
    return (seed - _FURTHER) // 100 if seed >= _FURTHER else (seed - 2000) // STREETS


def render_street(
    folder: Path,
    group: int,
    seed: int,
    *,
    size: float,
    frames: int = FRAMES,
    step_m: float = STEP_M,
) -> tuple[Rig, Rig]:
    """Render one street of a group's sensor, if the folder does not have it yet.

    Returns:
        The rig as its owner states it, and with every camera at its alignment; the folder has both.
    """
    _, make_rig, beams = RIGS[group % len(RIGS)]
    truth, errors = make_rig(), draw_scan_errors(beams, size, np.random.default_rng([7, group]))
    if not (folder / "rig.yaml").exists():
        render(folder, truth, beams, errors, frames=frames, step_m=step_m, seed=seed)
    stated = draw_lens_errors(truth, size / 2, np.random.default_rng([13, group]))  # of all streets
    aligned = aligned_rig(truth, stated, folder, beams, errors)
    aligned.save(folder / ALIGNMENT)
    stated.save(folder / "reference.yaml")
    return stated, aligned


def calibrate_street(folder: Path, guess: Rig, *, interval_s: float | None = None) -> Calibration:
    """Calibrate a street, and keep the tables beside it."""
    guess.save(folder / "rig.yaml")
    data = load_dataset(folder, interval_s=interval_s)
    result = calibrate(data, data.rig)
    assert result.correspondences is not None
    result.correspondences.save(folder / "correspondences.parquet")
    if result.camera_matches is not None:
        result.camera_matches.save(folder / "camera_matches.parquet")
    result.rig.save(folder / "result.yaml")
    return result


def run_case(case: Key, scenes: Path) -> Record:
    """Render one street, calibrate from near the truth, keep the tables beside it."""
    folder = scenes / f"scene_{case.seed}"
    truth, aligned = render_street(folder, group_of(case.seed), case.seed, size=float(case.data))
    guess = perturb(truth, rotation_deg=GUESS_DEG, translation_m=GUESS_M, seed=case.seed)
    result = calibrate_street(folder, guess)
    spreads = {name: r.sigma_px for name, r in result.residuals.items()}
    return {**ledger.to_record(result, aligned), "spread_px": spreads,
            "z_score": dict(result.correspondences.findings.z_score),
            "probability": {n: v.error_probability and v.error_probability.probability
                            for n, v in result.camera_verdicts.items()}}  # fmt: skip


@dataclass(frozen=True)
class Streets:
    """What is solved together.

    Attributes:
        truth: the rig as it is.
        aligned: per camera, the mean of the streets' alignments.
        start: the rig to start from, with relative poses if any are known.
        table: of all streets, with places.
        matches: of pairs of cameras; None without any.
    """

    truth: Rig
    aligned: dict[str, np.ndarray]
    start: Rig
    table: Correspondences
    matches: CameraMatches | None


def load_streets(folders: Sequence[Path]) -> Streets:
    """The tables of some streets of one sensor."""
    truth, tables, pairs, places = load_rig(folders[0] / "reference.yaml"), [], [], []
    for number, folder in enumerate(folders):
        table, add = load_correspondences(folder / "correspondences.parquet"), number * FRAMES
        tables.append(replace(table, frame=table.frame + add))
        places.append(list(range(add, add + FRAMES)))
        if (folder / "camera_matches.parquet").is_file():
            matches = load_camera_matches(folder / "camera_matches.parquet")
            pairs.append(replace(matches, frame=matches.frame + add))
    joined = concatenate(tables)
    stated = error_components().matchers["structure"]  # also where tables are older
    joined = replace(joined, metadata={**joined.metadata, **stated, "places": places})
    matches = concatenate_camera_matches(pairs) if pairs else None
    aligned = mean_poses([load_rig(folder / ALIGNMENT).T_camera_lidar for folder in folders])
    return Streets(truth, aligned, load_rig(folders[0] / "result.yaml"), joined, matches)


def solve_streets(streets: Streets) -> Iterator[tuple[str, Record]]:
    """Errors of each camera, with its verdict, and of each next to the one before it."""
    truth = streets.truth
    solved = solve_joint(
        streets.start, streets.table, Config(stage1="rig", learnt_weights=False),
        camera_matches=streets.matches,
    )  # fmt: skip
    evidence = Evidence(solved, streets.start)
    verdicts = to_calibration(evidence, assess(evidence), evidence.cameras).camera_verdicts
    joint, mount = solved.covariance, solved.mount
    assert joint is not None and mount.covariance is not None
    errors, T = [], mount.T_camera_lidar
    for place, name in enumerate(T):
        errors.append(twist_between(T[name], truth.cameras[name].T_camera_lidar))
        rows = slice(6 * place, 6 * place + 6)
        error = twist_between(solved.T_camera_lidar[name], streets.aligned[name])
        yield "camera", _found(error, joint[rows, rows], verdicts[name].status)
        if place:
            T_b_a = relative_transform(T[name], T[list(T)[place - 1]])
            between = errors[place] - gtsam.Pose3(T_b_a).AdjointMap() @ errors[place - 1]
            of_pair = relative_covariance(mount.covariance, place - 1, place, T_b_a)
            yield "pair", _found(between, of_pair)


def _found(error: np.ndarray, covariance: np.ndarray, status: str = "") -> Record:
    """As a camera's part of a record."""
    return {
        "normalised_squared": float(error @ np.linalg.solve(covariance, error)) / 6,
        "error_deg": float(np.degrees(np.linalg.norm(error[:3]))),
        "error_cm": 100 * float(np.linalg.norm(error[3:])),
        "status": status,
    }


def without_pairs(streets: Streets, rng: np.random.Generator) -> Streets:
    """What cameras see in common is not used."""
    return replace(streets, matches=None)


def tied(streets: Streets, rng: np.random.Generator) -> Streets:
    """The relative pose of the first two cameras is measured, to 0.02 deg and 0.3 cm."""
    sigmas = {"rotation_sigma_rad": np.radians(0.02), "translation_sigma_m": 0.003}
    a, b = list(streets.truth.cameras)[:2]
    T = streets.truth.T_camera_lidar
    error = np.repeat([*sigmas.values()], 3) * rng.standard_normal(6)
    measured = relative_transform(T[a], T[b]) @ gtsam.Pose3.Expmap(error).matrix()
    pose = RelativePose(a=a, b=b, T_a_b=measured, **sigmas)
    start = streets.start.model_copy(update={"relative_poses": (pose,)})
    return replace(streets, start=start, matches=None)


def few_frames(streets: Streets, rng: np.random.Generator, *, count: int) -> Streets:
    """The first camera has matches in so many frames alone."""
    table, first = streets.table, next(iter(streets.truth.cameras))
    own = table.camera_index == table.cameras.index(first)
    kept = table.select(~own | (table.frame < count))
    return replace(streets, table=kept, matches=None)


def repeated(streets: Streets, rng: np.random.Generator) -> Streets:
    """The frames of the first street ten times, as if they were of other places."""
    first = streets.table.select(streets.table.frame < FRAMES)
    more = [replace(first, frame=first.frame + 1000 * copy) for copy in range(1, 10)]
    table = replace(concatenate([streets.table, *more]), metadata=streets.table.metadata)
    return replace(streets, table=table)


CHANGES: dict[str, Callable[[Streets, np.random.Generator], Streets]] = {
    "as they are": lambda streets, rng: streets,
    "without pairs": without_pairs,
    "tied by 0.02 deg 0.3 cm": tied,
    "first camera without matches, tied": lambda streets, rng: tied(
        few_frames(streets, rng, count=0), rng
    ),
    "1 frame of the first camera": partial(few_frames, count=1),
    "3 frames of the first camera": partial(few_frames, count=3),
    "first street 10 times": repeated,
}


_CELLS = (
    "results", "mean NEES / 6", "in the 95 % region", "error, median [deg]", "largest", "[cm]",
    "largest", "PASS, WARN, FAIL", "of these off",
)  # fmt: skip


def _cells(found: Sequence[Record]) -> tuple[str, ...]:
    """Errors of cameras or pairs in their error bars, their sizes, and verdicts."""
    deg, cm = (np.array([one[f"error_{unit}"] for one in found]) for unit in ("deg", "cm"))
    nees = [6 * one["normalised_squared"] for one in found if one["normalised_squared"]]
    sizes = f"{np.median(deg):.3f}", f"{deg.max():.2f}", f"{np.median(cm):.2f}", f"{cm.max():.1f}"
    judged = [one for one in found if one["status"]]
    off = [one for one in judged if class_of(one) == "off"]
    counts = (
        ", ".join(str(sum(one["status"] == status for one in of)) for status in STATUSES)
        for of in (judged, off)
    )
    return str(len(found)), *calibration(nees), *sizes, *counts


def report(records: Sequence[Record]) -> Table:
    """A row per size of the sensor's errors, and one of all."""
    done = [record for record in records if "cameras" in record]
    rows = []
    for size in (*sorted({record["data"] for record in done}), "all"):
        cameras = [c for r in done if size in (r["data"], "all") for c in r["cameras"].values()]
        rows.append((size, *_cells(cameras)))
    return Table("One place of three frames each", ("size of errors", *_CELLS), tuple(rows))


def report_together(records: Sequence[Record], scenes: Path) -> list[Table]:
    """A row per number of places and size of the errors, and per change of five places."""
    places: dict[tuple[int, str, str], list[Record]] = {}
    changes: dict[tuple[str, str, str], list[Record]] = {}
    for size, folders in streets_of_groups(records, scenes):
        for count in (1, 2, STREETS, 10, 20):
            for start in range(0, len(folders) - count + 1, count):
                for of, what in solve_streets(load_streets(folders[start : start + count])):
                    places.setdefault((count, size, of), []).append(what)
        for name, change in CHANGES.items() if len(folders) >= STREETS else ():
            rng = np.random.default_rng([11, int(folders[0].name.split("_")[1])])
            for of, what in solve_streets(change(load_streets(folders[:STREETS]), rng)):
                changes.setdefault((name, size, of), []).append(what)
    title = "Streets of one sensor solved together"
    return [
        Table(title, ("places", "size", "of", *_CELLS),
              tuple((*map(str, key), *_cells(found)) for key, found in sorted(places.items()))),
        Table(f"{title}, changed", ("five places", "size", "of", *_CELLS),
              tuple((*key, *_cells(found)) for key, found in changes.items())),
    ]  # fmt: skip


def streets_of_groups(records: Sequence[Record], scenes: Path) -> Iterator[tuple[str, list[Path]]]:
    """Of each group the size of the sensor's errors, and its streets."""
    sizes = {record["seed"]: record["data"] for record in records if "cameras" in record}
    for group in sorted({group_of(seed) for seed in sizes}):
        seeds = sorted(seed for seed in sizes if group_of(seed) == group)
        yield sizes[seeds[0]], [scenes / f"scene_{seed}" for seed in seeds]


if __name__ == "__main__":
    main()
