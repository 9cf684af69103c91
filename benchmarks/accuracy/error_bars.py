"""Error bars over many rendered scenes with sensors that err, each scene once.

    python -m benchmarks.accuracy.error_bars --scenes out/error_bars --groups 0:72 --jobs 2

A group is a sensor with errors of its own, and five streets that it drove through, three frames
each: one place. Rigs, beams and the size of the errors change from group to group. The second table
solves again with the correspondences of one, two and five of a group's streets. NEES is the squared
error in the metric of its covariance; its mean over 6 should be 1.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import gtsam
import numpy as np
from scipy.stats import chi2

from benchmarks.accuracy import ledger
from benchmarks.accuracy.ledger import Key, Record
from benchmarks.tables import ROOT, Table, add_record_option
from calibgraph import (
    Camera,
    Config,
    Intrinsics,
    Rig,
    calibrate,
    load_camera_matches,
    load_correspondences,
    load_dataset,
    load_rig,
    perturb,
    simulate_street,
)
from calibgraph.model.camera_matches import concatenate_camera_matches
from calibgraph.model.correspondences import concatenate
from calibgraph.model.geometry import relative_covariance, relative_transform, twist_between
from calibgraph.simulation.rigs import rig_of
from calibgraph.simulation.scan_errors import draw_scan_errors
from calibgraph.solver.joint import solve_joint
from calibgraph.trust.evidence import Evidence

STREETS = 5
FRAMES, STEP_M = 3, 4.0
SIZES = (0.0, 0.5, 1.0, 2.0)
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
        Key("scene", RIGS[group % len(RIGS)][0], str(SIZES[group // len(RIGS) % len(SIZES)]), seed)
        for group in range(first, last)
        for seed in range(2000 + STREETS * group, 2000 + STREETS * (group + 1))
    ]
    work = partial(run_case, scenes=arguments.scenes)
    records = ledger.records_of(arguments, cases, work)
    tables = [report(records), report_places(records, arguments.scenes)]
    ledger.publish_cases("accuracy.error_bars", tables, records, record=arguments.record)


def parse_options() -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=Path, default=ROOT / "out" / "error_bars")
    parser.add_argument(
        "--groups", type=lambda text: [int(n) for n in text.split(":")], default=[12, 72]
    )
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "error_bars.jsonl")
    parser.add_argument("--summary", type=Path, help="print the tables of a file, run no scene")
    add_record_option(parser)
    return parser.parse_args()


def run_case(case: Key, scenes: Path) -> Record:
    """Render one street, calibrate from near the truth, keep the tables beside it."""
    group = (case.seed - 2000) // STREETS
    _, make_rig, beams = RIGS[group % len(RIGS)]
    folder, truth = scenes / f"scene_{case.seed}", make_rig()
    size, rng = float(case.data), np.random.default_rng([7, group])
    if not (folder / "rig.yaml").exists():
        shutil.rmtree(folder, ignore_errors=True)
        simulate_street(
            folder, truth, beams=beams, frames=FRAMES, step_m=STEP_M, seed=case.seed,
            sensor_errors=draw_scan_errors(beams, size, rng),
        )  # fmt: skip
    guess = perturb(truth, rotation_deg=GUESS_DEG, translation_m=GUESS_M, seed=case.seed)
    result = calibrate(load_dataset(folder), guess)
    assert result.correspondences is not None
    result.correspondences.save(folder / "correspondences.parquet")
    if result.camera_matches is not None:
        result.camera_matches.save(folder / "camera_matches.parquet")
    result.rig.save(folder / "result.yaml")
    spreads = {name: r.sigma_px for name, r in result.residuals.items()}
    return {**ledger.to_record(result, truth), "spread_px": spreads,
            "z_score": dict(result.correspondences.findings.z_score),
            "probability": {n: None if v.doubt is None else v.doubt.probability
                            for n, v in result.camera_verdicts.items()}}  # fmt: skip


COLUMNS = (
    "sensor errors", "cameras", "rotation, median [deg]", "largest", "position, median [cm]",
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
        counts = [sum(c["status"] == s for c in cameras) for s in ("PASS", "WARN", "FAIL")]
        rows.append(
            (size, str(len(cameras)), f"{np.median(deg):.3f}", f"{deg.max():.2f}",
             f"{np.median(cm):.2f}", f"{cm.max():.1f}", *_calibration(nees),
             str(np.sum((deg > OFF[0]) | (cm > OFF[1]))), ", ".join(map(str, counts)))
        )  # fmt: skip
    return Table("One place of three frames each", COLUMNS, tuple(rows))


OFF = (0.5, 10.0)  # deg, cm


def _calibration(nees_over_6: Iterable[float]) -> tuple[str, str]:
    values = np.array(list(nees_over_6))
    return f"{values.mean():.2f}", f"{np.mean(6 * values < chi2.ppf(0.95, 6)):.1%}"


def report_places(records: Sequence[Record], scenes: Path) -> Table:
    """A row per number of places and size of the errors: cameras and pairs."""
    found: dict[tuple[int, str, str], list[float]] = {}
    sizes = {record["seed"]: record["data"] for record in records if "cameras" in record}
    for first in sorted(seed for seed in sizes if (seed - 2000) % STREETS == 0):
        seeds = [seed for seed in range(first, first + STREETS) if seed in sizes]
        for places in (1, 2, STREETS):
            for start in range(0, len(seeds) - places + 1, places):
                folders = [scenes / f"scene_{seed}" for seed in seeds[start : start + places]]
                for what, nees in solve_places(folders):
                    found.setdefault((places, sizes[first], what), []).append(nees / 6)
    rows = [
        (str(places), size, what, str(len(values)), *_calibration(values))
        for (places, size, what), values in sorted(found.items())
    ]
    columns = ("places", "sensor errors", "of", "results", "mean NEES / 6", "in the 95 % region")
    return Table("Streets of one sensor solved together", columns, tuple(rows))


def solve_places(folders: Sequence[Path]) -> Iterator[tuple[str, float]]:
    """NEES of each camera, and of each next to the one before it, by the tables of some streets."""
    truth, tables, pairs, places = load_rig(folders[0] / "reference.yaml"), [], [], []
    for number, folder in enumerate(folders):
        table, add = load_correspondences(folder / "correspondences.parquet"), number * FRAMES
        tables.append(replace(table, frame=table.frame + add))
        places.append(list(range(add, add + FRAMES)))
        if (folder / "camera_matches.parquet").is_file():
            matches = load_camera_matches(folder / "camera_matches.parquet")
            pairs.append(replace(matches, frame=matches.frame + add))
    joined = concatenate(tables)
    joined = replace(joined, metadata={**joined.metadata, "places": places})
    solved = solve_joint(
        load_rig(folders[0] / "result.yaml"), joined,
        Config(stage1="rig", learnt_weights=False),
        camera_matches=concatenate_camera_matches(pairs) if pairs else None,
    )  # fmt: skip
    joint = Evidence(solved, guess=truth).joint_covariance
    assert joint is not None
    errors, T = [], solved.T_camera_lidar
    for place, name in enumerate(T):
        errors.append(twist_between(T[name], truth.cameras[name].T_camera_lidar))
        rows = slice(6 * place, 6 * place + 6)
        yield "camera", _nees(errors[-1], joint[rows, rows])
        if place:
            T_b_a = relative_transform(T[name], T[list(T)[place - 1]])
            between = errors[place] - gtsam.Pose3(T_b_a).AdjointMap() @ errors[place - 1]
            yield "pair", _nees(between, relative_covariance(joint, place - 1, place, T_b_a))


def _nees(error: np.ndarray, covariance: np.ndarray) -> float:
    return float(error @ np.linalg.solve(covariance, error))


if __name__ == "__main__":
    main()
