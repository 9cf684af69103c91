"""Error bars over many rendered scenes with sensors that err, each scene once.

    python -m benchmarks.accuracy.error_bars --scenes out/error_bars --groups 12:72 --jobs 2

A group is a sensor with errors of its own, and five streets that it drove through, three frames
each: one place. Rigs, beams and the size of the errors change from group to group. Groups 0 to 11
are for choosing constants, the others for counting.
"""

from __future__ import annotations

import argparse
import shutil
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.accuracy import ledger
from benchmarks.accuracy.ledger import Key, Record
from benchmarks.tables import ROOT
from calibgraph import Camera, Intrinsics, Rig, calibrate, load_dataset, perturb, simulate_street
from calibgraph.simulation.rigs import rig_of
from calibgraph.simulation.scan_errors import draw_scan_errors

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
    ledger.records_of(arguments, cases, work)


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
    parser.add_argument("--summary", type=Path, help="print the tables of a file, run nothing")
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


if __name__ == "__main__":
    main()
