"""The files of a fleet's model: shrunk estimates, nominal poses with spreads, priors as rigs."""

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from calibgraph.arrays import Array
from calibgraph.errors import RigError
from calibgraph.files import write_atomically, write_text
from calibgraph.fleet.findings import find_changes, moved_lidars
from calibgraph.fleet.fit import Mount, Pooled
from calibgraph.fleet.model import FleetModel, ModelFit
from calibgraph.model.geometry import invert
from calibgraph.model.rig import RelativePose, Rig

ESTIMATES_FILE, MODEL_FILE = "estimates.parquet", "fleet_model.json"
FORMAT = "calibgraph-fleet-model/1"


def write_fleet_model(fleet: FleetModel, folder: Path, rigs: Mapping[str, Rig]) -> list[Path]:
    """Write what a fleet knows.

    Raises:
        RigError: if a rig has a camera that the fleet has not measured.
        FileError: if a file cannot be written.
    """
    priors = {
        _file_name("prior", name, batch): prior_rig(rig, fleet.models[name], batch or None)
        for name, rig in rigs.items()
        for batch in ("", *_batches(fleet.models[name]))
    }
    table, paths = estimates(fleet), [folder / ESTIMATES_FILE, folder / MODEL_FILE]
    write_atomically(paths[0], lambda path: parquet.write_table(table, path))
    write_text(paths[1], json.dumps(summary(fleet), indent=1))
    for name, rig in priors.items():
        rig.save(folder / name)
    return [*paths, *(folder / name for name in priors)]


def estimates(fleet: FleetModel) -> pa.Table:
    """A row per vehicle and camera: its estimate with what the fleet knows."""
    of = fleet.observations
    return pa.table({
        **{name: getattr(of, name) for name in ("vehicle", "camera", "model", "batch")},
        "T_camera_lidar": _lists(fleet.T_camera_lidar, 16),
        "covariance": _lists(fleet.covariance, 36),
        "deviation": _lists(np.where(of.measured[:, None], fleet.deviation, np.nan), 6),
        "moved_probability": fleet.moved,
        "stands_apart": fleet.apart,
        "measured": of.measured,
    })  # fmt: skip


def _lists(values: Any, size: int) -> pa.FixedSizeListArray:
    return pa.FixedSizeListArray.from_arrays(pa.array(np.ravel(values)), size)


def summary(fleet: FleetModel) -> dict[str, Any]:
    """What is known of every model, and what happened, in plain numbers."""
    return {
        "format": FORMAT,
        "models": {name: _model(model) for name, model in fleet.models.items()},
        "findings": [
            {"kind": finding.kind, "text": finding.text, "p_value": finding.p_value,
             "change": None if finding.kind == "mount" else finding.change.tolist(),
             "sigma": None if finding.kind == "mount" else finding.sigma.tolist()}
            for finding in find_changes(fleet)
        ],
        "moved_lidars": moved_lidars(fleet),
    }  # fmt: skip


def _model(model: ModelFit) -> dict[str, Any]:
    return {
        "cameras": {name: _mount(mount, model.pooled) for name, mount in model.mounts.items()},
        "reference": model.reference,
        "relative_poses": {n: _mount(m, model.pooled_pairs) for n, m in model.pairs.items()},
        "moved_share": model.pooled.share_moved,
    }


def _mount(mount: Mount, pooled: Pooled) -> dict[str, Any]:
    """Nominal pose, and the covariances of a further vehicle, and of vehicles within a batch."""
    T, covariance = expected_pose(mount, pooled)
    return {
        "vehicles": len(mount.seen.vehicle),
        "T": T.tolist(),
        "covariance_of_a_vehicle": covariance.tolist(),
        "spread_within_a_batch": mount.spread.tolist(),
        "batches": {name: T.tolist()
                    for name, T in zip(mount.batches, mount.centers.batches, strict=True)},
    }  # fmt: skip


def _batches(model: ModelFit) -> list[str]:
    """The batches that all cameras of a model have."""
    named = [set(mount.batches) for mount in model.mounts.values()]
    return sorted(name for name in set.intersection(*named) if name)


def _file_name(*words: str) -> str:
    """Of a file; characters that a path cannot hold become underscores."""
    return "_".join(re.sub(r"[^\w.-]", "_", word) for word in words if word) + ".yaml"


_LEAST_SIGMA = 1e-5  # of a relative pose in a rig file


def expected_pose(mount: Mount, pooled: Pooled, batch: str | None = None) -> tuple[Array, Array]:
    """Where a further vehicle's camera is, unless it is moved in its mount.

    Returns:
        (4, 4) T_camera_lidar; (6, 6) covariance of xi in T_camera_lidar = exp(xi) that, which
        holds the spread of vehicles and batches and the uncertainty of the nominal pose.
    """
    centers = mount.centers
    if batch is None:
        between = centers.nominal_covariance + pooled.batch * mount.spread
        return centers.nominal, mount.spread + between
    if batch not in mount.batches:
        raise ValueError(
            f"unknown batch {batch!r} of camera {mount.camera!r}; known are "
            f"{', '.join(mount.batches)}"
        )
    index = mount.batches.index(batch)
    return centers.batches[index], mount.spread + centers.batch_covariance[index]


def prior_rig(rig: Rig, model: ModelFit, batch: str | None = None) -> Rig:
    """A rig for a further vehicle: its guess, and relative poses that `solve` takes as measured.

    Every relative pose is from the first camera. Its sigma is that of the axis along which it
    varies most, because a rig file has one for all axes; so it is never too small. Errors of two
    relative poses share the deviation of the first camera, which the solve does not take into
    account.

    Raises:
        RigError: if the rig has a camera that the fleet has not measured.
    """
    unknown = [name for name in rig.cameras if name not in model.mounts]
    if unknown:
        raise RigError(
            f"camera {unknown[0]!r} of the rig is not among the fleet's "
            f"{', '.join(model.mounts)}; give it the same name in both, or take it out",
            camera=unknown[0],
        )
    pairs = [mount for name, mount in model.pairs.items() if name in rig.cameras]
    if model.reference not in rig.cameras:
        pairs = []
    poses = {name: expected_pose(model.mounts[name], model.pooled, batch)[0]
             for name in rig.cameras}  # fmt: skip
    relative = [_relative_pose(model.reference, pair, model.pooled_pairs, batch) for pair in pairs]
    return rig.moved_to(poses).model_copy(update={"relative_poses": tuple(relative)})


def _relative_pose(reference: str, pair: Mount, pooled: Pooled, batch: str | None) -> RelativePose:
    """The pose of one camera in the first one."""
    known = batch if batch in pair.batches else None
    T_b_a, covariance = expected_pose(pair, pooled, known)
    return RelativePose(
        a=reference,
        b=pair.camera,
        T_a_b=invert(T_b_a),
        rotation_sigma_rad=_widest(covariance[:3, :3]),
        translation_sigma_m=_widest(covariance[3:, 3:]),
    )


def _widest(covariance: Array) -> float:
    """Standard deviation along the axis that varies most."""
    return max(_LEAST_SIGMA, math.sqrt(float(np.linalg.eigvalsh(covariance)[-1])))
