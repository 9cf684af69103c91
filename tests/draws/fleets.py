"""Simulated fleets with known deviations: rows as `calibgraph fleet` writes them."""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import csv

from calibgraph import MatcherErrors, perturb, simulate_correspondences
from calibgraph.arrays import Array
from calibgraph.child_process import Outcome
from calibgraph.fleet.job import Limits, execute
from calibgraph.fleet.manifest import Job
from calibgraph.model.geometry import relative_transform, retract_all
from calibgraph.simulation.rigs import rig_of

CAMERAS = ("front", "front_left", "front_right", "left", "rear", "right")
MODELS = ("compact", "van")
SPREAD = np.array([np.radians(0.15)] * 3 + [0.004] * 3)
POOR = 0.3


@dataclass(frozen=True)
class Fleet:
    """Rows, and the truth behind them.

    Attributes:
        rows: the table.
        T_camera_lidar: (n, 4, 4) true.
        moved: (n,) whether the camera was moved.
        poor: (n,) whether its vehicle was poorly observed.
    """

    rows: pa.Table
    T_camera_lidar: Array
    moved: NDArray[np.bool_]
    poor: NDArray[np.bool_]


def simulate_fleet(
    rng: np.random.Generator, vehicles: int = 500, *, moved_share: float = 0.05
) -> Fleet:
    """A fleet of two models with six cameras each.

    Args:
        rng: of all draws.
        vehicles: in all; the model is drawn.
        moved_share: of the cameras: by 1 degree and 2 cm in a random direction.
    """
    model, poor = rng.integers(2, size=vehicles), rng.random(vehicles) < POOR
    v, c = np.repeat(np.arange(vehicles), 6), np.tile(np.arange(6), vehicles)
    nominal = np.array([_random_pose(rng) for _ in range(12)]).reshape(2, 6, 4, 4)
    mixing = np.array([_correlation(rng) for _ in CAMERAS])
    d = np.einsum("nij,nj->ni", mixing[c], rng.normal(size=(len(c), 6)))
    moved = rng.random(len(v)) < moved_share
    d[moved] += _directions(rng, int(np.count_nonzero(moved))) * np.radians(1)
    truth = retract_all(nominal[model[v], c], -d)
    covariance = _noise(rng, poor[v])
    errors = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), rng.normal(size=d.shape))
    rows = _table((model[v], poor[v], rng.uniform(0, 365, vehicles)[v]),
                  retract_all(truth, -errors), covariance)  # fmt: skip
    return Fleet(rows, truth, moved, poor[v])


def _table(plan: tuple[NDArray[Any], ...], T_camera_lidar: Array, covariance: Array) -> pa.Table:
    """The rows, six cameras to a vehicle, by its model, whether it is poor, and the day."""
    model, poor, day = plan
    vehicle = np.arange(len(model)) // 6
    start = np.datetime64("2026-01-01T00:00:00", "us")
    return pa.table({
        "vehicle": [f"V{i:06d}" for i in vehicle],
        "camera": [*CAMERAS] * (len(model) // 6),
        "model": [MODELS[i] for i in model],
        "status": ["done"] * len(vehicle),
        "verdict": np.where(poor, "WARN", "PASS").tolist(),
        "reasons": [["few frames"] if p else [] for p in poor],
        "T_camera_lidar": _lists(T_camera_lidar, 16),
        "covariance": _lists(covariance, 36),
        "date": start + (day * 86_400e6).astype("timedelta64[us]"),
    })  # fmt: skip


def _lists(values: Array, size: int) -> pa.FixedSizeListArray:
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), size)


def _random_pose(rng: np.random.Generator) -> Array:
    twist = rng.normal(size=(1, 6)) * [1, 1, 1, 0.5, 0.5, 0.5]
    return np.asarray(retract_all(np.eye(4)[None], twist)[0], np.float64)


def _correlation(rng: np.random.Generator) -> Array:
    """(6, 6) root of a covariance with SPREAD on its diagonal."""
    root = np.linalg.cholesky(np.corrcoef(rng.normal(size=(6, 20)) + rng.normal(size=20)))
    return np.asarray(SPREAD[:, None] * root)


def _directions(rng: np.random.Generator, count: int) -> Array:
    """(n, 6) rotations of 1 rad and translations of 1.15 m (2 cm per degree)."""
    w, t = rng.normal(size=(2, count, 3))
    w, t = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (w, t))
    return np.column_stack([w, 0.02 / np.radians(1) * t])


def _noise(rng: np.random.Generator, poor: NDArray[np.bool_]) -> Array:
    """(n, 6, 6) covariances of measurements: of poor vehicles ten times the standard deviation."""
    root = rng.normal(size=(len(poor), 6, 12)) / np.sqrt(12)
    sigma = np.where(poor, 0.5, 0.05)[:, None] * [*np.radians([1.0] * 3), 0.03, 0.03, 0.03]
    root = sigma[:, :, None] * root
    return np.asarray(root @ root.transpose(0, 2, 1))


def errors_of(T_camera_lidar: Array, truth: Array) -> Array:
    """(n,) angle [rad] between estimates and truth."""
    R = relative_transform(T_camera_lidar, truth)[:, :3, :3]
    cosine = (np.trace(R, axis1=1, axis2=2) - 1) / 2
    return np.asarray(np.arccos(np.clip(cosine, -1, 1)), np.float64)


def write_fleet(folder: Path, vehicles: int, *, frames: int = 6, matches: int = 60) -> Path:
    """Write the tables of a fleet, each of its own rig, and their manifest.

    Each vehicle is 0.3 degrees and 2 cm off the nominal rig ``kitti``.

    Args:
        folder: for all files.
        vehicles: how many.
        frames: of each table.
        matches: per camera and frame.

    Returns:
        The manifest, CSV.
    """
    folder.mkdir(parents=True, exist_ok=True)
    nominal = rig_of("kitti")
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


def run_here(job: Job, limits: Limits, _: str) -> Outcome:
    """Run a job in this process, in place of ``run_job``."""
    with TemporaryDirectory() as folder:
        return execute(job, limits, Path(folder))
