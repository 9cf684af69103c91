"""The data of ``accuracy.audit``: recordings, and rendered streets with a LiDAR that errs."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.accuracy.alignment import ALIGNMENT, aligned_rig, mean_poses
from benchmarks.accuracy.error_bars import RIGS
from benchmarks.accuracy.scenes import GUESS_DEG, GUESS_M, Folders
from calibgraph import (
    Dataset,
    Rig,
    calibrate,
    load_dataset,
    load_rig,
    perturb,
    simulate_street,
)
from calibgraph.simulation.scan_errors import draw_scan_errors

RECORDINGS = ("00", "05", "06", "07", "08", "05+06+07+08", "kitti_raw_0005")
ONE_RIG = ("05", "06", "07", "08")
"""Of one rig: the result of each is also taken for what is deployed when another is audited."""
ENOUGH = ("00", "05", "kitti_raw_0005")
"""Of enough frames for an answer, and not longer than needed."""

DISPLACED_SCENES = 24
STREETS, FRAMES, STEP_M = 3, 2, 8.0
SENSOR_ERRORS = 1.0
_SEED = 4000


@dataclass(frozen=True)
class Sources:
    """Where recordings are, and where streets are or will be.

    Attributes:
        recordings: their folder.
        scenes: a folder per scene, ``scene_0``, ``scene_1``, ...
    """

    recordings: Path
    scenes: Path

    def load(self, name: str) -> tuple[Dataset, Rig]:
        """Data by name, and the right rig; a scene is rendered if it is not there yet.

        Of a scene cameras are at their alignments: where their LiDAR, which errs, sees them.
        """
        if not name.startswith("scene_"):
            return Folders(self.recordings, None).load(name)
        streets = self.render(int(name.removeprefix("scene_")))
        aligned = mean_poses([load_rig(street / ALIGNMENT).T_camera_lidar for street in streets])
        return load_dataset(streets), load_rig(streets[0] / "reference.yaml").moved_to(aligned)

    def render(self, number: int) -> list[Path]:
        """Folders of the streets through which one sensor drove, each a place of its own."""
        _, make_rig, beams = RIGS[number % len(RIGS)]
        rng, folders = np.random.default_rng([8, number]), []
        errors = draw_scan_errors(beams, SENSOR_ERRORS, rng)
        for street in range(STREETS):
            folders.append(self.scenes / f"scene_{number}" / f"street_{street}")
            if (folders[-1] / ALIGNMENT).exists():
                continue
            shutil.rmtree(folders[-1], ignore_errors=True)
            simulate_street(
                folders[-1], make_rig(), beams=beams, frames=FRAMES, step_m=STEP_M,
                seed=_SEED + STREETS * number + street, sensor_errors=errors, vary_layout=True,
            )  # fmt: skip
            truth = load_rig(folders[-1] / "reference.yaml")
            aligned = aligned_rig(truth, truth, folders[-1], beams, errors)
            aligned.save(folders[-1] / ALIGNMENT)
        return folders

    def result(self, name: str) -> Rig:
        """The rig as ``calibrate`` finds it from a recording."""
        path = self.scenes / f"result_{name}.yaml"
        if not path.exists():
            data, truth = self.load(name)
            guess = perturb(truth, rotation_deg=GUESS_DEG, translation_m=GUESS_M, seed=0)
            calibrate(data, guess).rig.save(path)
        return load_rig(path)


def ring() -> list[str]:
    """Data to displace, to go round in: three scenes, one recording, and so on; of odd length."""
    names = []
    for number in range(DISPLACED_SCENES):
        names.append(f"scene_{number}")
        if number % 3 == 2:
            names.append(ENOUGH[number // 3 % len(ENOUGH)])
    return names[:-1]
