"""Relative poses of two cameras from their images and the LiDAR's surfaces, without anything else.

    python -m benchmarks.accuracy.camera_pairs RECORDING ... [--starts 5]

The first camera of every pair that overlaps is displaced from the reference, and held there by the
size of its displacement alone; the other starts as far off. Surfaces are taken again from every
estimate.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.tables import Table, add_record_option, publish
from calibgraph import CameraMatches, Dataset, Rig, load_dataset, load_rig, match_cameras, perturb
from calibgraph.matching.camera_pairs import with_surfaces
from calibgraph.model.config import Config
from calibgraph.model.geometry import pose_difference, relative_transform
from calibgraph.solver.camera_pairs import pair_terms
from calibgraph.solver.pair_refinement import fit_pair
from factors import pose_sigmas

Array = NDArray[np.float64]
Pair = tuple[str, str]

DISPLACED = {"0.15 deg, 3 cm": (0.15, 0.03), "1.5 deg, 30 cm": (1.5, 0.3)}
ROUNDS = 3


def main() -> None:
    """Measure all recordings, print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--starts", type=int, default=5, help="draws of the displacement")
    add_record_option(parser)
    arguments = parser.parse_args()
    rows = [row for folder in arguments.recordings for row in rows_of(folder, arguments.starts)]
    columns = ("pair", "A displaced by", "matches", "median deg", "largest deg",
               "median cm", "largest cm", "matching s/frame", "fit s")  # fmt: skip
    table = Table("Relative pose of two cameras against the reference", columns, tuple(rows))
    publish("accuracy.camera_pairs", [table], record=arguments.record)


def rows_of(folder: Path, starts: int) -> list[tuple[str, ...]]:
    """The lines of one recording."""
    data = load_dataset(folder)
    reference = load_rig(
        folder / "reference.yaml" if (folder / "reference.yaml").is_file() else folder
    )
    begin = time.process_time()
    matches = match_cameras(data, reference)
    matching_s = (time.process_time() - begin) / len(data.frames)
    rows = []
    for pair in matches.pairs():
        own = matches.of_pair(*pair)
        for label, size in DISPLACED.items():
            begin = time.process_time()
            errors = np.array([error(data, reference, own, pair, size, seed)
                               for seed in range(starts)])  # fmt: skip
            cells = [f"{folder.name} {pair[0]}, {pair[1]}", label, f"{len(own)}"]
            cells += [f"{each:.3f}" for each in (np.median(errors[:, 0]), errors[:, 0].max())]
            cells += [f"{each:.2f}" for each in (np.median(errors[:, 1]), errors[:, 1].max())]
            fit_s = (time.process_time() - begin) / starts
            rows.append((*cells, f"{matching_s:.2f}", f"{fit_s:.1f}"))
    return rows


def error(
    data: Dataset,
    reference: Rig,
    matches: CameraMatches,
    pair: Pair,
    size: tuple[float, float],
    seed: int,
) -> tuple[float, float]:
    """Of T_b_a: deg and cm; NaN if there is too little in common."""
    start = perturb(reference, rotation_deg=size[0], translation_m=size[1], seed=seed)
    per_axis = np.array(size) / np.sqrt(3)
    held = pose_sigmas(rotation_rad=np.radians(per_axis[0]), translation_m=per_axis[1])
    rig = start
    for _ in range(ROUNDS):
        terms = pair_terms(rig, with_surfaces(matches, data, rig), Config())
        if not terms:
            return np.nan, np.nan
        around = dict(start.T_camera_lidar)
        rig = start.moved_to(fit_pair(pair, terms, around, np.diag(held**2)))
    both = [relative_transform(r.T_camera_lidar[pair[1]], r.T_camera_lidar[pair[0]])
            for r in (rig, reference)]  # fmt: skip
    return pose_difference(*both)


if __name__ == "__main__":
    main()
