"""The result: one type for every solver, complete enough to judge it, use it and repeat it."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from calibgraph.config import Config, Terms
from calibgraph.correspondences import Correspondences
from calibgraph.errors import FileError
from calibgraph.files import checked_model, read_yaml, write_yaml
from calibgraph.rig import Rig

Array = NDArray[np.float64]

CALIBRATION_FORMAT = "calibgraph-calibration/1"
CALIBRATION_FILE = "calibration.yaml"
CORRESPONDENCES_FILE = "correspondences.parquet"

FRAMES_SENTENCE = "p_camera = T_camera_lidar * p_lidar"
TANGENT_SENTENCE = (
    "T_camera_lidar = exp(xi) * estimate, "
    "xi = (rotation [rad], translation [m]) in the camera's axes"
)

Status = Literal["PASS", "WARN", "FAIL"]


def _versions() -> dict[str, str]:
    """What made the result: this package and the libraries that matter."""
    versions = {"python": platform.python_version()}
    for package in ("calibgraph", "gtsam", "numpy", "numba", "opencv-python-headless", "scipy"):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "not installed as a package"
    return versions


@dataclass(frozen=True)
class Verdict:
    """Whether a result can be used.

    Attributes:
        status: PASS, WARN or FAIL.
        reasons: what was checked and found wanting, a sentence each; empty for PASS.
    """

    status: Status
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True)
class Residuals:
    """How well the result explains one camera's correspondences.

    Attributes:
        median_px: median unweighted error over the preprocessed correspondences; for a match that
            constrains one direction only, the error along it.
        inlier_share: share of them that the gate kept.
        sigma_px: the residuals' robust spread (per axis).
        loss_scale_px: delta that was used.
        gate_px: tau that was used.
    """

    median_px: float
    inlier_share: float
    sigma_px: float
    loss_scale_px: float
    gate_px: float


@dataclass(frozen=True, eq=False, repr=False)
class Calibration:
    """A calibrated rig.

    Attributes:
        rig: the rig with the estimated poses.
        initial_rig: the rig that the solve started from.
        covariance: clustered by frames, plus the error that the matcher says its frames share:
            per camera, (6, 6) of xi in T_camera_lidar = exp(xi) estimate, xi = (rotation
            [rad], translation [m]) in the camera's axes; None with too few frames to tell.
        joint_covariance: (6 N, 6 N) over all cameras in the rig's order, or None.
        verdict: of the rig: the worst of its cameras'.
        camera_verdicts: per camera.
        residuals: per camera that had correspondences.
        counts: per camera, what was left after each filter and gate, and the frames.
        timings_s: seconds per stage.
        terms: which terms of the objective were used.
        config: the resolved settings.
        stage1_T_camera_lidar: the pairwise estimates.
        rounds: of ``calibrate``: per round and camera, the matches and how far it moved.
        correspondences: of the last round of ``calibrate``.
        inputs: SHA-256 of the input files, by path.
        versions: of this package and the libraries that matter.
    """

    rig: Rig
    initial_rig: Rig
    covariance: dict[str, Array | None]
    joint_covariance: Array | None
    verdict: Verdict
    camera_verdicts: dict[str, Verdict]
    residuals: dict[str, Residuals]
    counts: dict[str, dict[str, int]]
    timings_s: dict[str, float]
    terms: Terms
    config: Config
    stage1_T_camera_lidar: dict[str, Array] = field(default_factory=dict)
    rounds: tuple[dict[str, Any], ...] = ()
    correspondences: Correspondences | None = None
    inputs: dict[str, str] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=_versions)

    @property
    def T_camera_lidar(self) -> dict[str, Array]:
        """Each camera's (4, 4) estimate: p_camera = T_camera_lidar * p_lidar."""
        return self.rig.T_camera_lidar

    def sigmas(self, name: str) -> tuple[Array, Array] | None:
        """A camera's standard deviations: (3,) rotation [deg], (3,) translation [cm], or None."""
        covariance = self.covariance[name]
        if covariance is None:
            return None
        sigmas = np.sqrt(np.diag(covariance))
        return np.degrees(sigmas[:3]), sigmas[3:] * 100.0

    def with_inputs(self, inputs: Mapping[str, str]) -> Calibration:
        """The same result, knowing the hashes of the files it came from."""
        return replace(self, inputs=dict(inputs))

    def save(self, folder: Path | str) -> Path:
        """Write ``calibration.yaml``, and the correspondences if there are any, into a folder.

        Each file appears whole or not at all. Returns the path of the YAML file.
        """
        path = Path(folder) / CALIBRATION_FILE
        if self.correspondences is not None:
            self.correspondences.save(path.with_name(CORRESPONDENCES_FILE))
        write_yaml(path, self._to_mapping())
        return path

    def __repr__(self) -> str:
        return f"Calibration({self.verdict.status}; {', '.join(self.rig.cameras)})"

    def _sigma_mapping(self, name: str) -> dict[str, list[float]] | None:
        covariance = self.covariance[name]
        if covariance is None:
            return None
        sigmas = np.sqrt(np.diag(covariance)).tolist()
        return {"rotation_rad": sigmas[:3], "translation_m": sigmas[3:]}

    def _to_mapping(self) -> dict[str, Any]:
        return {
            "format": CALIBRATION_FORMAT,
            "verdict": _verdict_mapping(self.verdict),
            "camera_verdicts": {k: _verdict_mapping(v) for k, v in self.camera_verdicts.items()},
            "frames": FRAMES_SENTENCE,
            "T_camera_lidar": self.T_camera_lidar,
            "sigmas": {name: self._sigma_mapping(name) for name in self.rig.cameras},
            "rig": self.rig.model_dump(),
            "covariance_of": TANGENT_SENTENCE,
            "covariance": dict(self.covariance),
            "joint_covariance": self.joint_covariance,
            "residuals": {name: vars(value) for name, value in self.residuals.items()},
            "counts": self.counts,
            "rounds": list(self.rounds),
            "initial_rig": self.initial_rig.model_dump(),
            "stage1_T_camera_lidar": self.stage1_T_camera_lidar,
            "terms": self.terms,
            "config": self.config.model_dump(),
            "timings_s": self.timings_s,
            "inputs": self.inputs,
            "versions": self.versions,
        }


def load_calibration(path: Path | str) -> Calibration:
    """Read a result, from its folder or its file.

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
        return Calibration(
            rig=checked_model(Rig, content["rig"], path),
            initial_rig=checked_model(Rig, content["initial_rig"], path),
            covariance={k: _array(v) for k, v in content["covariance"].items()},
            joint_covariance=_array(content["joint_covariance"]),
            verdict=_verdict(content["verdict"]),
            camera_verdicts={k: _verdict(v) for k, v in content["camera_verdicts"].items()},
            residuals={k: Residuals(**v) for k, v in content["residuals"].items()},
            stage1_T_camera_lidar={
                k: np.array(v) for k, v in content["stage1_T_camera_lidar"].items()
            },
            config=checked_model(Config, content["config"], path),
            rounds=tuple(content["rounds"]),
            **{name: content[name] for name in _PLAIN},
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise FileError(path, f"is not a complete result ({error!r}); write it again") from error


_PLAIN = ("counts", "timings_s", "terms", "inputs", "versions")
assert {*_PLAIN} <= {f.name for f in fields(Calibration)}


def is_calibration(content: Mapping[str, Any]) -> bool:
    """Whether the content of a YAML file is a result."""
    return content.get("format") == CALIBRATION_FORMAT


def rig_of_calibration(content: Mapping[str, Any], path: Path) -> Rig:
    """The calibrated rig in the content of a result file."""
    if "rig" not in content:
        raise FileError(path, "is a result without a rig; write it again")
    return checked_model(Rig, content["rig"], path)


def _verdict_mapping(verdict: Verdict) -> dict[str, Any]:
    return {"status": verdict.status, "reasons": list(verdict.reasons)}


def _verdict(content: Mapping[str, Any]) -> Verdict:
    return Verdict(content["status"], tuple(content["reasons"]))


def _array(value: Any) -> Array | None:
    return None if value is None else np.array(value, dtype=np.float64)
