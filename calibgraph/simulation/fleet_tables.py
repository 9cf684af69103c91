"""A simulated fleet of tables: a manifest, and per vehicle a table and its true rig."""

from pathlib import Path

import pyarrow as pa
from pyarrow import csv

from calibgraph import MatcherErrors, perturb, simulate_correspondences
from calibgraph.simulation.rigs import rig_of


def write_fleet(
    folder: Path, vehicles: int, *, frames: int = 6, matches: int = 60, rig: str = "kitti"
) -> Path:
    """Write the tables of a fleet, each of its own rig, and their manifest.

    Args:
        folder: for all files.
        vehicles: how many.
        frames: of each table.
        matches: per camera and frame.
        rig: name of the nominal one, from which each vehicle is 0.3 degrees and 2 cm off.

    Returns:
        The manifest, CSV.
    """
    folder.mkdir(parents=True, exist_ok=True)
    nominal = rig_of(rig)
    nominal.save(folder / "nominal.yaml")
    names = [f"car-{number:05d}" for number in range(vehicles)]
    for seed, name in enumerate(names):
        truth = perturb(nominal, rotation_deg=0.3, translation_m=0.02, seed=seed)
        errors = MatcherErrors(noise_px=1.0, outlier_share=0.1)
        table = simulate_correspondences(
            truth, frames=frames, matches=matches, errors=errors, seed=seed
        )
        table.save(folder / f"{name}.parquet")
    columns = {
        "vehicle": names,
        "recording": [f"{name}.parquet" for name in names],
        "rig": ["nominal.yaml"] * vehicles,
        "batch": [f"{seed % 3}" for seed in range(vehicles)],
        "mileage_km": [1000.0 * seed for seed in range(vehicles)],
    }
    csv.write_csv(pa.table(columns), folder / "fleet.csv")
    return folder / "fleet.csv"
