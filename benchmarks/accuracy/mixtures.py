"""Rendered drives of rigs whose lens and clock are wrong, before and after these are estimated.

    python -m benchmarks.accuracy.mixtures --scenes FOLDER [--rigs 0:64] [--out FILE]

A drive has five stops, 15 m apart, of a camera like KITTI's on a car, with a LiDAR of wide beams
and biased ranges: eight rigs in town at 2 to 15 m/s, the next eight on a road, nearly straight, at
10 m/s give or take 3 %. Images are rendered at their rows' times. Rigs take turns with what is
wrong: focal length (0.3 to 5 %), centre (3 to 30 px), k1 (0.01 to 0.1), offset (5 to 100 ms),
read-out (0 to 30 ms), both times, the whole lens, all of it. Each is calibrated from a start 1
degree and 10 cm off: with the right values, with the wrong ones, and with the wrong ones estimated.
Scenes are rendered once.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.accuracy.lens import values_of
from benchmarks.tables import parser_of
from calibgraph import Config, Rig, calibrate, perturb
from calibgraph.model.geometry import twist_between
from tests.draws.lenses import put_lens_error
from tools.scenes.rolling_drives import WRONG, draw_wrong, load_drive, truth_of


def wrong_rig(truth: Rig, wrong: dict[str, float]) -> Rig:
    """The rig as it is stated: at the right pose, without times."""
    rig = truth
    for part in ("focal", "centre", "distortion"):
        if part in wrong:
            rig = put_lens_error(rig, part, wrong[part])  # type: ignore[arg-type]
    cameras = {
        name: camera.model_copy(update={"time_offset_s": None, "readout_s": None})
        for name, camera in rig.cameras.items()
    }
    return rig.model_copy(update={"cameras": cameras})


def run(seed: int, folder: Path) -> Iterator[dict[str, Any]]:
    """A rig with the right values, with wrong ones, and with these estimated."""
    truth, wrong = truth_of(seed), draw_wrong(seed)
    data, stated = load_drive(folder, seed), wrong_rig(truth, wrong)
    for case, rig, estimate in (
        ("right", truth, ()), ("wrong", stated, ()), ("estimated", stated, WRONG[seed % len(WRONG)])
    ):  # fmt: skip
        start = perturb(rig, rotation_deg=1.0, translation_m=0.1, seed=seed)
        before = time.process_time()
        result = calibrate(data, start, config=Config(estimate=estimate))
        seconds = time.process_time() - before
        for name, camera in truth.cameras.items():
            error = twist_between(result.rig.T_camera_lidar[name], camera.T_camera_lidar)
            covariance, verdict = result.covariance[name], result.camera_verdicts[name]
            right = values_of(camera)
            yield {
                "seed": seed, "case": case, "wrong": wrong, "cpu_s": round(seconds, 1),
                "deg": float(np.degrees(np.linalg.norm(error[:3]))),
                "cm": 100 * float(np.linalg.norm(error[3:])),
                "nees": float(error @ np.linalg.solve(covariance, error)) / 6,
                "verdict": verdict.status, "probability": verdict.error_probability.probability,
                "reasons": [
                    f"{c.kind or c.name} {c.value}" for c in verdict.checks if c.status != "PASS"
                ],
                "lens": {
                    one.name: (one.value - right[one.name], one.sigma, one.prior_sigma)
                    for one in result.lens.get(name, ()) if one.name in right
                },
            }  # fmt: skip


def main() -> None:
    """Render, calibrate, and write a line per result."""
    parser = parser_of(__doc__)
    parser.add_argument("--scenes", type=Path, required=True)
    parser.add_argument("--rigs", default="0:64")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--render", action="store_true", help="nothing but the scenes")
    options = parser.parse_args()
    for seed in range(*map(int, options.rigs.split(":"))):
        if options.render:
            load_drive(options.scenes, seed)
            continue
        for found in run(seed, options.scenes):
            line = json.dumps(found)
            print(line, flush=True)
            if options.out:
                with options.out.open("a") as file:
                    file.write(line + "\n")


if __name__ == "__main__":
    main()
