"""Pin results before a change, compare them after it: poses, error bars, verdicts of whole runs.

``python tools/hold.py run FOLDER [CASE ...]`` calibrates each case with the code of the current
directory; ``python tools/hold.py compare BEFORE AFTER`` prints a line per camera and fails where a
pose moved by more than ``--sigmas`` of its own error bar or a verdict is another.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from calibgraph import load_calibration
from calibgraph.model.geometry import twist_between

REALDATA = Path(os.environ.get("CALIBGRAPH_REALDATA", "../shared/realdata"))
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


def run(folder: Path, name: str) -> None:
    """Calibrate a case from its guess, unless its result is there."""
    where, offset = CASES[name]
    data = Path(where) if name == "sample" else REALDATA / where
    if (folder / name / "calibration.yaml").is_file():
        return
    folder.mkdir(parents=True, exist_ok=True)
    guess = folder / f"{name}.yaml"
    rig = data / "reference.yaml" if (data / "reference.yaml").is_file() else data
    options = ["--rig", str(guess)] if offset else []
    if offset and not guess.is_file():
        degrees, metres = map(str, offset)
        shift = ["--rotation-deg", degrees, "--translation-m", metres, "--seed", "0"]
        _call("perturb", str(rig), *shift, "--out", str(guess))
    _call("calibrate", str(data), *options, "--out", str(folder / name))


def _call(*arguments: str) -> None:
    command = [sys.executable, "-m", "calibgraph", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 1):  # 1: the result is FAIL, and written
        raise SystemExit(f"{' '.join(command)}: {done.stderr}")


def compare(before: Path, after: Path, *, sigmas: float) -> int:
    """Print how far each camera moved; the number of cameras that differ."""
    differ = 0
    for name in sorted({path.parent.name for path in before.glob("*/calibration.yaml")}):
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
    return differ


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    runs = commands.add_parser("run")
    runs.add_argument("folder", type=Path)
    runs.add_argument("cases", nargs="*", default=list(CASES))
    compares = commands.add_parser("compare")
    compares.add_argument("before", type=Path)
    compares.add_argument("after", type=Path)
    compares.add_argument("--sigmas", type=float, default=1e-6)
    asked = parser.parse_args()
    if asked.command == "run":
        for name in asked.cases:
            run(asked.folder, name)
            print(json.dumps({"case": name}), flush=True)
    else:
        sys.exit(bool(compare(asked.before, asked.after, sigmas=asked.sigmas)))


if __name__ == "__main__":
    main()
