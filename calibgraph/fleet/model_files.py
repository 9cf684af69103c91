"""The files of a fleet's model: shrunk estimates, nominal poses with spreads, priors as rigs."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from calibgraph.files import write_atomically, write_text
from calibgraph.fleet.findings import find_changes, moved_lidars
from calibgraph.fleet.fit import Mount, Pooled
from calibgraph.fleet.model import FleetModel, ModelFit
from calibgraph.fleet.prior import expected_pose, prior_rig
from calibgraph.model.rig import Rig
from calibgraph.outputs import Output, marked_yaml, yaml_mark

ESTIMATES_FILE, MODEL_FILE = "estimates.parquet", "fleet_model.json"
FORMAT = "calibgraph-fleet-model/1"
COMMAND = "fleet-model"
_MARK = f'{{\n "format": "{FORMAT}"'.encode()


def outputs_of_fleet_model(folder: Path) -> list[Output]:
    """The files in a folder; its priors are those there."""
    model = folder / MODEL_FILE
    return [
        Output(model, COMMAND, (_MARK,)),
        Output(folder / ESTIMATES_FILE, COMMAND, (_MARK,), marked=model),
        *(marked_yaml(path, COMMAND) for path in folder.glob("prior_*.yaml")),
    ]


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
        rig.save(folder / name, first_line=yaml_mark(COMMAND))
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
