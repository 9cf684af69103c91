"""Two versions of the code on the same calibrations: poses, error bars, verdicts and times.

    python -m tools.hold run .=out/before                     # pin results before a change
    python -m tools.hold run .=out/after                      # and after it
    python -m tools.hold run ../before=out/before .=out/after --cases sample 00 --repeats 3
    python -m tools.hold compare out/before out/after

Each run is the command ``calibgraph calibrate`` of a source tree in a process of its own. Several
trees take turns, so that other load meets all; times are the shortest of the repeats, the first of
which may compile. ``compare`` prints a line per camera and case, and fails where a pose moved by
more than ``--sigmas`` of its own error bar or a verdict is another.
"""

import json
import os
import resource
import subprocess
import sys
import time
from itertools import product
from pathlib import Path

import numpy as np

from benchmarks.accuracy.ledger import REALDATA
from benchmarks.tables import parser_of
from calibgraph import load_calibration, load_rig, perturb
from calibgraph.model.geometry import twist_between

KITTI = "kitti_odometry/sequences"
CASES = {  # data, degrees and metres from the reference; None: the guess of the folder
    "sample": ("data/sample", None),
    **{name: (f"{KITTI}/{name}", (20, 1.5)) for name in ("00", "05", "06", "07", "08", "10")},
    "kitti_places": ("kitti_places", (20, 1.5)),
    "raw_0005": ("kitti_raw_0005", (20, 1.5)),
    "surround6": ("surround6", None),
    "nuscenes_a": ("nuscenes_a", (2, 0.2)),
    "dgp_scene01": ("dgp_scene01", (2, 0.2)),
}
RESULT, TIMES = "calibration.yaml", "times.json"


def run(tree: Path, folder: Path, name: str) -> None:
    """Calibrate a case with the code of a tree from its guess, and keep the times."""
    where, offset = CASES[name]
    data = tree / where if name == "sample" else REALDATA / where
    folder.mkdir(parents=True, exist_ok=True)
    words = [str(data), "--out", str(folder / name)]
    if offset:
        reference = data / "reference.yaml" if (data / "reference.yaml").is_file() else data
        guess = folder / f"{name}.yaml"
        perturb(load_rig(reference), rotation_deg=offset[0], translation_m=offset[1]).save(guess)
        words += ["--rig", str(guess)]
    command = [sys.executable, "-m", "calibgraph", "calibrate", *words]
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    done = subprocess.run(
        command, cwd=tree, env=environment, capture_output=True, text=True, check=False
    )
    wall_s, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode not in (0, 1):  # 1: the result is FAIL, and written
        raise SystemExit(f"{' '.join(command)}: {done.stderr}")
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    kept = times_of(folder, name)
    best = [min(new, old) for new, old in zip((wall_s, cpu_s), kept, strict=True)]
    (folder / name / TIMES).write_text(json.dumps(best), "utf-8")
    print(f"{name}, {tree}: {wall_s:.1f} s, CPU {cpu_s:.1f} s", flush=True)


def times_of(folder: Path, name: str) -> list[float]:
    """The shortest wall and processor seconds of a case so far."""
    path = folder / name / TIMES
    return list(json.loads(path.read_text("utf-8"))) if path.is_file() else [np.inf, np.inf]


def compare(before: Path, after: Path, *, sigmas: float) -> int:
    """Print how far each camera moved, and times; the number of cameras that differ."""
    differ = 0
    for name in sorted({path.parent.name for path in before.glob(f"*/{RESULT}")}):
        old, new = (load_calibration(folder / name) for folder in (before, after))
        for camera, pose in old.T_camera_lidar.items():
            twist = np.asarray(twist_between(pose, new.T_camera_lidar[camera]))
            sigma = np.sqrt(np.diag(old.covariance[camera]))
            ratio = np.sqrt(np.diag(new.covariance[camera])) / sigma
            was, now = old.camera_verdicts[camera], new.camera_verdicts[camera]
            moved = float(np.abs(twist / sigma).max())
            other = moved > sigmas or was.status != now.status
            differ += other
            print(
                f"{name:12} {camera:20} {'DIFFERS' if other else 'same':8}"
                f" {np.degrees(np.linalg.norm(twist[:3])):8.4f} deg"
                f" {100 * np.linalg.norm(twist[3:]):7.3f} cm {moved:8.4f} sigma,"
                f" bars x {ratio.min():.3f} to {ratio.max():.3f}, {was.status} {was.percent} "
                f"-> {now.status} {now.percent}"
            )
        wall, cpu = zip(*(times_of(folder, name) for folder in (before, after)), strict=True)
        if np.isfinite([*wall, *cpu]).all():
            print(f"{name:12} wall {wall[0]:.1f} -> {wall[1]:.1f} s, CPU {cpu[0]:.1f} -> "
                  f"{cpu[1]:.1f} s")  # fmt: skip
    return differ


def main() -> None:
    """Run the command line."""
    parser = parser_of(__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    runs = commands.add_parser("run")
    runs.add_argument("trees", nargs="+", metavar="TREE=FOLDER", help="source tree, its results")
    runs.add_argument("--cases", nargs="+", default=[*CASES], choices=[*CASES])
    runs.add_argument("--repeats", type=int, default=1, help="with 1, what is there is kept")
    compares = commands.add_parser("compare")
    compares.add_argument("before", type=Path)
    compares.add_argument("after", type=Path)
    compares.add_argument("--sigmas", type=float, default=1e-6)
    asked = parser.parse_args()
    if asked.command == "compare":
        sys.exit(bool(compare(asked.before, asked.after, sigmas=asked.sigmas)))
    pairs = [[Path(part).resolve() for part in words.split("=")] for words in asked.trees]
    for name, _, (tree, folder) in product(asked.cases, range(asked.repeats), pairs):
        if asked.repeats > 1 or not (folder / name / RESULT).is_file():
            run(tree, folder, name)


if __name__ == "__main__":
    main()
