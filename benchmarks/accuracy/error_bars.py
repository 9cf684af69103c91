"""Error bars over many rendered scenes with sensors and lenses that err, each scene once.

    python -m benchmarks.accuracy.error_bars --groups 116:180 --jobs 2
    python -m benchmarks.accuracy.error_bars --groups 116:120 --streets 20

A group is a rig with errors of its own, and five streets that it drove through, three frames each:
one place. Rigs and beams change from group to group; errors of the LiDAR are those of ``simulate
street --sensor-errors SIZE --vary-layout``, those of the lenses of half the size. Groups 100 to 115
are to choose by, 116 to 179 are kept out. The second table solves again with the correspondences of
one, two, five, ten and twenty of a group's streets, as far as it has as many, and has the verdicts
of those tables, without images; the third with those of five, changed: a relative pose is known, a
camera has no matches or few, frames are repeated.
Errors of cameras are of their alignment, those of pairs of their mounts.
NEES is the squared error in the metric of its covariance; its mean over 6 should be 1.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from benchmarks.accuracy import ledger
from benchmarks.accuracy.alignment import ALIGNMENT, aligned_rig
from benchmarks.accuracy.ledger import Key, Record
from benchmarks.accuracy.streets import CHANGES, FRAMES, Found, load_streets, solve_streets
from benchmarks.tables import ROOT, Table, add_record_option
from calibgraph import (
    Camera,
    Intrinsics,
    Rig,
    calibrate,
    load_dataset,
    perturb,
    simulate_street,
)
from calibgraph.simulation.rigs import rig_of
from calibgraph.simulation.scan_errors import draw_scan_errors
from tools.scenes.lens_errors import draw_lens_errors

STREETS = 5
_FURTHER = 100_000  # seeds of more streets than that
STEP_M = 4.0
GUESS_DEG, GUESS_M = 1.0, 0.1
FORWARD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def pair() -> Rig:
    """KITTI's stereo pair, of half the size."""
    lens = Intrinsics(fx=359.4, fy=359.4, cx=303.6, cy=92.6)
    places = {"left": (0.27, 0.06, -0.08), "right": (0.27, -0.48, -0.08)}
    return Rig(cameras={n: _camera(620, 188, lens, xyz, 0.9) for n, xyz in places.items()})


def wide() -> Rig:
    """Two cameras of 93 degrees, half to the left and half to the right."""
    lens = Intrinsics(fx=303.0, fy=303.0, cx=319.5, cy=199.5)
    views = {"left": ((0.3, 0.2, -0.2), 35.0), "right": ((0.3, -0.2, -0.2), -35.0)}
    return Rig(cameras={n: _camera(640, 400, lens, *view) for n, view in views.items()})


def _camera(
    width: int, height: int, lens: Intrinsics, xyz_m: tuple[float, ...], yaw_deg: float
) -> Camera:
    turn, (sine, cosine) = np.eye(3), (np.sin(np.radians(yaw_deg)), np.cos(np.radians(yaw_deg)))
    turn[:2, :2] = [[cosine, sine], [-sine, cosine]]
    T = np.eye(4)
    T[:3, :3] = FORWARD @ turn
    T[:3, 3] = -T[:3, :3] @ xyz_m
    return Camera(width_px=width, height_px=height, intrinsics_px=lens, T_camera_lidar=T)


RIGS = (("pair", pair, 64), ("sample", partial(rig_of, "sample"), 64),
        ("wide", wide, 64), ("sector", partial(rig_of, "sample"), 32))  # fmt: skip


def main() -> None:
    """Render, calibrate, keep a line of each."""
    arguments = parse_options()
    first, last = arguments.groups
    cases = [
        Key("scene", RIGS[group % len(RIGS)][0], f"{arguments.size:g}", seed)
        for group in range(first, last)
        for seed in seeds_of(group, arguments.streets)
    ]
    work = partial(run_case, scenes=arguments.scenes)
    records = ledger.records_of(arguments, cases, work)
    tables = [
        report(records),
        report_places(records, arguments.scenes),
        report_changes(records, arguments.scenes),
    ]
    ledger.publish_cases("accuracy.error_bars", tables, records, record=arguments.record)


def parse_options() -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=Path, default=ROOT / "out" / "error_bars")
    parser.add_argument(
        "--groups", type=lambda text: [int(n) for n in text.split(":")], default=[100, 180]
    )
    parser.add_argument("--size", type=float, default=2.0, help="of the errors; one folder each")
    parser.add_argument("--streets", type=int, default=STREETS, help="of each sensor")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "error_bars.jsonl")
    parser.add_argument("--summary", type=Path, help="print the tables of a file, run no scene")
    add_record_option(parser)
    return parser.parse_args()


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
        shutil.rmtree(folder, ignore_errors=True)
        simulate_street(
            folder, truth, beams=beams, frames=frames, step_m=step_m, seed=seed,
            sensor_errors=errors, vary_layout=True,
        )  # fmt: skip
    stated = draw_lens_errors(truth, size / 2, np.random.default_rng([13, group]))  # of all streets
    aligned = aligned_rig(truth, stated, folder, beams, errors)
    aligned.save(folder / ALIGNMENT)
    stated.save(folder / "reference.yaml")
    return stated, aligned


def run_case(case: Key, scenes: Path) -> Record:
    """Render one street, calibrate from near the truth, keep the tables beside it."""
    folder = scenes / f"scene_{case.seed}"
    truth, aligned = render_street(folder, group_of(case.seed), case.seed, size=float(case.data))
    guess = perturb(truth, rotation_deg=GUESS_DEG, translation_m=GUESS_M, seed=case.seed)
    guess.save(folder / "rig.yaml")
    result = calibrate(load_dataset(folder), guess)
    assert result.correspondences is not None
    result.correspondences.save(folder / "correspondences.parquet")
    if result.camera_matches is not None:
        result.camera_matches.save(folder / "camera_matches.parquet")
    result.rig.save(folder / "result.yaml")
    spreads = {name: r.sigma_px for name, r in result.residuals.items()}
    return {**ledger.to_record(result, aligned), "spread_px": spreads,
            "z_score": dict(result.correspondences.findings.z_score),
            "probability": {n: v.error_probability and v.error_probability.probability
                            for n, v in result.camera_verdicts.items()}}  # fmt: skip


COLUMNS = (
    "size of errors", "cameras", "rotation, median [deg]", "largest", "position, median [cm]",
    "largest", "mean NEES / 6", "in the 95 % region", "off", "PASS, WARN, FAIL",
)  # fmt: skip


def report(records: Sequence[Record]) -> Table:
    """A row per size of the sensor's errors, and one of all."""
    done = [record for record in records if "cameras" in record]
    rows = []
    for size in (*sorted({record["data"] for record in done}), "all"):
        cameras = [c for r in done if size in (r["data"], "all") for c in r["cameras"].values()]
        deg, cm = (np.array([c[f"error_{unit}"] for c in cameras]) for unit in ("deg", "cm"))
        nees = np.array([c["normalised_squared"] for c in cameras if c["normalised_squared"]])
        counts = [sum(c["status"] == s for c in cameras) for s in STATUSES]
        rows.append(
            (size, str(len(cameras)), f"{np.median(deg):.3f}", f"{deg.max():.2f}",
             f"{np.median(cm):.2f}", f"{cm.max():.1f}", *_calibration(nees),
             str(np.sum((deg > OFF[0]) | (cm > OFF[1]))), ", ".join(map(str, counts)))
        )  # fmt: skip
    return Table("One place of three frames each", COLUMNS, tuple(rows))


OFF = (0.5, 10.0)  # deg, cm
STATUSES = ("PASS", "WARN", "FAIL")


def _calibration(nees_over_6: Iterable[float]) -> tuple[str, str]:
    values = np.array(list(nees_over_6))
    return f"{values.mean():.2f}", f"{np.mean(6 * values < chi2.ppf(0.95, 6)):.1%}"


def report_places(records: Sequence[Record], scenes: Path) -> Table:
    """A row per number of places and size of the errors: cameras and pairs."""
    found: dict[tuple[int, str, str], list[Found]] = {}
    for size, folders in streets_of_groups(records, scenes):
        for places in (1, 2, STREETS, 10, 20):
            for start in range(0, len(folders) - places + 1, places):
                for what in solve_streets(load_streets(folders[start : start + places])):
                    found.setdefault((places, size, what.of), []).append(what)
    rows = [
        (str(places), size, of, *_cells(values))
        for (places, size, of), values in sorted(found.items())
    ]
    columns = ("places", "size", "of", *_CELLS)
    return Table("Streets of one sensor solved together", columns, tuple(rows))


def report_changes(records: Sequence[Record], scenes: Path) -> Table:
    """A row per change and size of the errors: five places."""
    found: dict[tuple[str, str, str], list[Found]] = {}
    for size, folders in streets_of_groups(records, scenes):
        if len(folders) < STREETS:
            continue
        streets = load_streets(folders[:STREETS])
        for name, change in CHANGES.items():
            rng = np.random.default_rng([11, int(folders[0].name.split("_")[1])])
            for what in solve_streets(change(streets, rng)):
                found.setdefault((name, size, what.of), []).append(what)
    rows = [(*key, *_cells(values)) for key, values in found.items()]
    columns = ("five places", "size", "of", *_CELLS)
    return Table("Streets of one sensor solved together, changed", columns, tuple(rows))


_CELLS = (
    "results", "mean NEES / 6", "in the 95 % region", "error, median [deg]", "[cm]",
    "PASS, WARN, FAIL", "of these off",
)  # fmt: skip


def _cells(values: Sequence[Found]) -> tuple[str, ...]:
    deg, cm = (np.median([getattr(one, unit) for one in values])
               for unit in ("degrees", "centimetres"))  # fmt: skip
    nees = _calibration(one.nees_over_6 for one in values)
    judged = [one for one in values if one.status]
    off = [one for one in judged if one.degrees > OFF[0] or one.centimetres > OFF[1]]
    counts = (
        ", ".join(str(sum(one.status == status for one in of)) for status in STATUSES)
        for of in (judged, off)
    )
    return str(len(values)), *nees, f"{deg:.3f}", f"{cm:.2f}", *counts


def streets_of_groups(records: Sequence[Record], scenes: Path) -> Iterator[tuple[str, list[Path]]]:
    """Of each group the size of the sensor's errors, and its streets."""
    sizes = {record["seed"]: record["data"] for record in records if "cameras" in record}
    for group in sorted({group_of(seed) for seed in sizes}):
        seeds = sorted(seed for seed in sizes if group_of(seed) == group)
        yield sizes[seeds[0]], [scenes / f"scene_{seed}" for seed in seeds]


if __name__ == "__main__":
    main()
