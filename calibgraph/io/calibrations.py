"""Results from disk: the YAML file of a calibration, and the table beside it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import FileError
from calibgraph.files import checked_model, read_yaml, sha256
from calibgraph.io.camera_match_tables import load_camera_matches
from calibgraph.io.correspondence_tables import load_correspondences
from calibgraph.model.calibration import Calibration, Residuals
from calibgraph.model.config import Config
from calibgraph.model.result_files import (
    CALIBRATION_FILE,
    CALIBRATION_FORMAT,
    CAMERA_MATCHES_FILE,
    CORRESPONDENCES_FILE,
)
from calibgraph.model.rig import Rig
from calibgraph.model.verdict import Check, Verdict

Array = NDArray[np.float64]
Table = TypeVar("Table")


def load_calibration(path: Path | str) -> Calibration:
    """Read a result, from its folder or its file, with the correspondences beside it.

    Raises:
        FileError: if it is missing or malformed.
    """
    path = Path(path)
    path = path / CALIBRATION_FILE if path.is_dir() else path
    content = read_yaml(path)
    if not is_calibration(content):
        raise FileError(
            path, f"has format {content.get('format')!r}, expected {CALIBRATION_FORMAT}"
        )
    try:
        found = Calibration(
            rig=checked_model(Rig, content["rig"], path),
            initial_rig=checked_model(Rig, content["initial_rig"], path),
            covariance={k: _array(v) for k, v in content["covariance"].items()},
            joint_covariance=_array(content["joint_covariance"]),
            camera_verdicts={k: _verdict(v) for k, v in content["camera_verdicts"].items()},
            residuals={k: Residuals(**v) for k, v in content["residuals"].items()},
            stage1_T_camera_lidar={
                k: np.array(v) for k, v in content["stage1_T_camera_lidar"].items()
            },
            config=checked_model(Config, content["config"], path),
            weaknesses={k: tuple(v) for k, v in content["weaknesses"].items()},
            bootstrap={k: np.array(v) for k, v in content["bootstrap_covariance"].items()},
            frames=tuple(content["frames_used"]),
            rounds=tuple(content["rounds"]),
            correspondences=_table(path, CORRESPONDENCES_FILE, content, load_correspondences),
            camera_matches=_table(path, CAMERA_MATCHES_FILE, content, load_camera_matches),
            **{name: content[name] for name in _PLAIN},
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise FileError(path, f"is not a complete result ({error!r}); write it again") from error
    _require_consistent(path, content, found)
    return found


def _require_consistent(path: Path, content: Mapping[str, Any], found: Calibration) -> None:
    """Check that the verdict is that of its checks, and all parts are of the same cameras.

    Raises:
        FileError: if not: the file was edited.
    """
    verdict = content.get("verdict", {})
    status = verdict.get("status") if isinstance(verdict, dict) else verdict
    if status != found.verdict.status:
        raise FileError(
            path,
            f"has the verdict {status}, its checks give {found.verdict.status}: it was edited; "
            "write it again",
        )
    names = set(found.rig.cameras)
    parts = {
        "initial_rig": found.initial_rig.cameras,
        "camera_verdicts": found.camera_verdicts,
        "counts": found.counts,
        "residuals": found.residuals,
    }
    for part, of in parts.items():
        if not isinstance(of, Mapping) or not names.issuperset(of):
            raise FileError(path, f"its {part} are not of the cameras of its rig; write it again")


_PLAIN = ("counts", "timings_s", "terms", "prior_share", "inputs", "versions")
assert {*_PLAIN} <= {f.name for f in fields(Calibration)}


def _table(
    result: Path, name: str, content: Mapping[str, Any], load: Callable[[Path], Table]
) -> Table | None:
    """A table of the result, if there is one.

    Args:
        result: path of the result's file.
        name: of the table's file beside it.
        content: of the result, with the table's hash; results of earlier versions have none.
        load: reads the table.

    Raises:
        FileError: if it is another table than that of the result.
    """
    path = result.with_name(name)
    if not path.is_file():
        return None
    found = sha256(path)
    if found != content.get(f"{path.stem}_sha256", found):
        raise FileError(
            path, f"is not the table of the {CALIBRATION_FILE} beside it; move it, or put the "
            "result's own there"
        )  # fmt: skip
    return load(path)


def is_calibration(content: Mapping[str, Any]) -> bool:
    """Whether the content of a YAML file is a result."""
    return content.get("format") == CALIBRATION_FORMAT


def rig_of_calibration(content: Mapping[str, Any], path: Path) -> Rig:
    """The calibrated rig in the content of a result file."""
    if "rig" not in content:
        raise FileError(path, "is a result without a rig; write it again")
    return checked_model(Rig, content["rig"], path)


def _verdict(content: Mapping[str, Any]) -> Verdict:
    return Verdict(tuple(Check(**check) for check in content["checks"]))


def _array(value: Any) -> Array | None:
    return None if value is None else np.array(value, dtype=np.float64)
