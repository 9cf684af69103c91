"""The result: one type for every solver, complete enough to check it, use it and repeat it."""

from __future__ import annotations

import platform
from collections import UserDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cache, cached_property
from importlib.metadata import PackageNotFoundError, version
from itertools import combinations
from pathlib import Path
from typing import Any, TypeVar

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.files import sha256, write_yaml, written_together
from calibgraph.model import geometry, result_files
from calibgraph.model.camera_matches import CameraMatches
from calibgraph.model.config import Config, Terms
from calibgraph.model.correspondences import TWISTS, Correspondences
from calibgraph.model.error_sources import ErrorSources
from calibgraph.model.lens import LensEstimate, joint_parameters
from calibgraph.model.places import Groups
from calibgraph.model.rig import Rig
from calibgraph.model.summary import Summary, summarize
from calibgraph.model.verdict import Verdict, rig_verdict

FRAMES_SENTENCE = "p_camera = T_camera_lidar * p_lidar"
TANGENT_SENTENCE = (
    "T_camera_lidar = exp(xi) * estimate, "
    "xi = (rotation [rad], translation [m]) in the camera's axes"
)
PAIR_TANGENT_SENTENCE = (
    "A->B: T_B_A = exp(xi) * estimate, xi = (rotation [rad], translation [m]) in the axes of B"
)


Value = TypeVar("Value")


class Later(UserDict[str, Value]):
    """Values by name, computed when they are first read; another process gets a dict."""

    def __init__(self, compute: Callable[[], Mapping[str, Value]]) -> None:
        self._compute = compute

    @cached_property
    def data(self) -> dict[str, Value]:  # type: ignore[override]
        """The values."""
        return dict(self._compute())

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (self.data,)


_PACKAGES = ("calibgraph", "gtsam", "numpy", "numba", "opencv-python-headless", "scipy")


def package_versions() -> dict[str, str]:
    """Versions of this package and of the libraries that results depend on."""
    return {"python": platform.python_version()} | {name: version_of(name) for name in _PACKAGES}


@cache  # reading the metadata of a package takes a millisecond
def version_of(package: str) -> str:
    """The version of an installed package."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed as a package"


@dataclass(frozen=True)
class Residuals:
    """Residuals of one camera's correspondences at the result.

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
    """A calibrated rig; what no check needs of it is computed when it is first read.

    Attributes:
        rig: the rig with the estimated extrinsics; of lenses and clocks that were estimated, with
            these and their standard deviations.
        initial_rig: the rig that the solve started from.
        covariance: the marginal of the error model: per camera, (6, 6) of xi in T_camera_lidar =
            exp(xi) estimate, xi = (rotation [rad], translation [m]) in the camera's axes; None
            where not determined.
        joint_covariance: (6 N, 6 N) over the sensors of ``joint_names``, or None.
        pair_covariance: per pair "A->B" of cameras with error bars, (6, 6) of xi in T_B_A = exp(xi)
            estimate, in B's axes: of the cameras as they are mounted, whatever the cloud.
        camera_verdicts: per camera.
        lidar_verdicts: per LiDAR but the base, of a rig of several.
        residuals: per camera that had correspondences.
        counts: per camera, correspondences left after each filter and the gate, and frames.
        timings_s: seconds per stage.
        terms: which terms of the objective were used.
        config: the resolved settings.
        stage1_T_camera_lidar: the pairwise estimates.
        weaknesses: per camera, the least determined directions, in words, the worst first.
        error_sources: per camera with an error bar, the shares of its sources.
        lens: per camera whose lens was estimated, its parameters; the lens itself is the rig's.
        lens_covariance: per camera of ``lens``, (6 + k, 6 + k) of xi and of its parameters in their
            order and units, as ``joint_parameters(lens[name])`` names them.
        frames: of ``calibrate``: per frame its ``frame`` number, ``name``, ``cloud`` file, and
            ``images``, a file per camera.
        moves: of ``track``: what moved, since when, how far, in words.
        motion: of ``track``: the column of its frames that has the motion of the LiDAR, or times of
            points, ``Correspondences.motion_column``.
        places: frame numbers of each place; empty if nobody looked for places, and of ``track``.
        rounds: of ``calibrate``: per round and camera, the matches and how far it moved.
        warnings: of ``calibrate``: about the dataset, its guess, and a lens that did not settle.
        correspondences: that the preprocessing kept; of ``calibrate``, of its last round.
        camera_matches: between cameras, with the surfaces used; None if they were not looked for.
        inputs: SHA-256 of the input files, by path.
        build_graph: see :attr:`graph`; None in a result from a file or another process.
        versions: of this package and the libraries that matter.
        date: day of the solve (UTC), YYYY-MM-DD; empty in results of earlier versions.
    """

    rig: Rig
    initial_rig: Rig
    covariance: dict[str, Array | None]
    joint_covariance: Array | None
    camera_verdicts: dict[str, Verdict]
    residuals: Mapping[str, Residuals]
    counts: dict[str, dict[str, int]]
    timings_s: dict[str, float]
    terms: Terms
    config: Config
    lidar_verdicts: dict[str, Verdict] = field(default_factory=dict)
    pair_covariance: Mapping[str, Array] = field(default_factory=dict)
    stage1_T_camera_lidar: dict[str, Array] = field(default_factory=dict)
    weaknesses: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    error_sources: Mapping[str, ErrorSources] = field(default_factory=dict)
    lens: dict[str, tuple[LensEstimate, ...]] = field(default_factory=dict)
    lens_covariance: dict[str, Array] = field(default_factory=dict)
    frames: tuple[dict[str, Any], ...] = ()
    moves: tuple[str, ...] = ()
    motion: str = ""
    places: Groups = ()
    rounds: tuple[Mapping[str, Any], ...] = ()
    warnings: tuple[str, ...] = ()
    correspondences: Correspondences | None = None
    camera_matches: CameraMatches | None = None
    inputs: dict[str, str] = field(default_factory=dict)
    build_graph: Callable[[], gtsam.NonlinearFactorGraph] | None = field(default=None, repr=False)
    versions: dict[str, str] = field(default_factory=package_versions)
    date: str = field(default_factory=lambda: datetime.now(UTC).date().isoformat())

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the graph, which does not leave its process."""
        return {**self.__dict__, "build_graph": None}

    @property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """The factor graph whose optimum is the result and whose marginal is its covariance.

        ``print(result.graph)`` lists every factor; ``calibgraph.graph.variables`` names the
        variables. With the paper's presets it is Eq. 5, and the covariance is the
        marginal of the error model that the preset ``auto`` fits.

        Raises:
            ValueError: of a result of a tracker, from a file or from another process.
        """
        if self.build_graph is None:
            raise ValueError(
                "a result of a tracker, a file or another process has no graph; solve a table"
            )
        return self.build_graph()

    @property
    def verdict(self) -> Verdict:
        """Of the rig: the worst of its sensors, with the checks of all."""
        return rig_verdict(self.verdicts)

    @property
    def verdicts(self) -> dict[str, Verdict]:
        """Per camera, and per LiDAR but the base."""
        return {**self.camera_verdicts, **self.lidar_verdicts}

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The sensors of ``joint_covariance``, 6 rows each: cameras, then LiDARs but the base.

        They are independent: cameras are calibrated to the base LiDAR alone.
        """
        return (*self.rig.cameras, *self.lidar_verdicts)

    @property
    def summary(self) -> Summary:
        """The verdict for people: the worst reasons, what to do, and the rest."""
        return self.summary_of(*self.verdicts)

    def summary_of(self, *cameras: str) -> Summary:
        """The same of some of its cameras and LiDARs."""
        verdicts = {name: self.verdicts[name] for name in cameras}
        weaknesses = {name: self.weaknesses.get(name, ()) for name in cameras}
        sources = {n: self.error_sources[n] for n in cameras if n in self.error_sources}
        return summarize(verdicts, weaknesses, sources, self.moves)

    @property
    def T_camera_lidar(self) -> dict[str, Array]:
        """Each camera's (4, 4) estimate: p_camera = T_camera_lidar * p_lidar."""
        return self.rig.T_camera_lidar

    @property
    def T_base_lidar(self) -> dict[str, Array]:
        """Each LiDAR's (4, 4) estimate: p_base = T_base_lidar * p_lidar; the base's identity."""
        return self.rig.T_base_lidar

    @property
    def T_vehicle_lidar(self) -> Array | None:
        """(4, 4) of the base: p_vehicle = T_vehicle_lidar * p_base; None without a vehicle."""
        return None if self.rig.vehicle is None else self.rig.vehicle.T_vehicle_lidar

    @property
    def vehicle_sigmas(self) -> Array | None:
        """(6,) of it, rotation [rad] and translation [m] in the vehicle's axes; inf: unknown."""
        return None if self.rig.vehicle is None else self.rig.vehicle.sigmas

    @property
    def T_lidar_camera(self) -> dict[str, Array]:
        """The (4, 4) inverses, each camera's pose in the LiDAR frame, as ROS's tf has it."""
        return {name: geometry.invert(T) for name, T in self.T_camera_lidar.items()}

    def sigmas(self, name: str) -> tuple[Array, Array] | None:
        """Standard deviations of a camera or pair "A->B", along the axes of the camera, or of B.

        Of a LiDAR, about and along the axes of the base.

        Returns:
            (3,) rotation [deg], (3,) translation [cm]; None where not determined.
        """
        covariance = self.covariance.get(name, self.pair_covariance.get(name))
        if name in self.lidar_verdicts:
            covariance = (self.rig.lidars or {})[name].covariance
        return None if covariance is None else geometry.degrees_and_centimetres(covariance)

    @property
    def unstated_lenses(self) -> str:
        """The cameras whose lenses count as calibrated, in a clause; empty if none does."""
        names = [name for name, c in self.rig.cameras.items() if c.intrinsics_sigma_px is None]
        if not names or {*self.config.estimate} - {"offset", "readout"}:
            return ""
        stated = "counts as calibrated (the rig states no intrinsics_sigma_px)"
        return f"lens of {', '.join(names)}: {stated}"

    @property
    def not_included(self) -> str:
        """The errors that the bars leave out: relative poses show the clouds' scale.

        By what was estimated, whether the LiDAR's motion is known, and when points were taken.
        Without either, clouds count as corrected for it.
        """
        table, estimated = self.correspondences, {*self.config.estimate}
        motion = self.motion if table is None else table.motion_column
        free = self.lens and estimated - {"offset", "readout"}
        lens = "other intrinsics" if free else "intrinsics"
        others = [] if motion == TWISTS or "offset" in estimated else ["time offset"]
        others += [] if motion else ["motion during a scan"]
        others += [] if self.rig.relative_poses else ["range scale"]
        return ", ".join([f"{lens} beyond what the rig states", *others])

    def error_bar_holds(self, name: str) -> bool:
        """Whether the covariance of a camera or pair "A->B" describes its error.

        It is computed around the result, so that it means nothing where a verdict is FAIL.
        """
        pairs = {f"{a}->{b}": (a, b) for a, b in combinations(self.rig.cameras, 2)}
        sensors = (name,) if name in self.verdicts else pairs[name]
        return all(self.verdicts[sensor].status != "FAIL" for sensor in sensors)

    def error_bar(self, name: str) -> tuple[Array, Array] | None:
        """The standard deviations of :meth:`sigmas` where they hold, else None."""
        return self.sigmas(name) if self.error_bar_holds(name) else None

    def joint_of_lens(self, name: str) -> dict[str, Any]:
        """The joint covariance of a camera's pose and lens, with the names of its rows."""
        rows = joint_parameters(self.lens[name])
        return {"parameters": rows, "covariance": self.lens_covariance[name].tolist()}

    def save(self, folder: Path | str) -> Path:
        """Write ``calibration.yaml``, and tables of the matches if there are any, into a folder.

        After an error none of them appears, and the YAML file is the last. Returns its path.

        Raises:
            FileError: if a table of these names is there that is not of a result.
        """
        path = Path(folder) / result_files.CALIBRATION_FILE
        result_files.require_own_tables(path.parent)
        tables = {
            result_files.CORRESPONDENCES_FILE: self.correspondences,
            result_files.CAMERA_MATCHES_FILE: self.camera_matches,
        }
        with written_together(path.parent, last=path.name) as new:
            content = self._to_mapping()
            for name, table in tables.items():
                key = f"{Path(name).stem}_sha256"
                content[key] = None
                if table is not None:
                    metadata = {**table.metadata, result_files.VERDICT_KEY: self.verdict.status}
                    replace(table, metadata=metadata).save(new / name)
                    content[key] = sha256(new / name)
            write_yaml(new / path.name, content)
        for name in (name for name, table in tables.items() if table is None):
            path.with_name(name).unlink(missing_ok=True)  # of an older result
        return path

    def __repr__(self) -> str:
        return f"Calibration({self.verdict.status}; {', '.join(self.verdicts)})"

    def _to_mapping(self) -> dict[str, Any]:
        cameras = self.rig.cameras
        content = {
            "format": result_files.CALIBRATION_FORMAT,
            "verdict": self.verdict.to_mapping(),
            "summary": self.summary,
            "camera_verdicts": _verdict_mapping(self.camera_verdicts),
            "lidar_verdicts": _verdict_mapping(self.lidar_verdicts),
            "frames": FRAMES_SENTENCE,
            "sigmas": {name: _sigma_mapping(self.covariance[name]) for name in cameras},
            "error_bar_holds": {
                name: self.error_bar_holds(name) for name in (*cameras, *self.pair_covariance)
            },
            "covariance_of": TANGENT_SENTENCE,
            "pair_covariance_of": PAIR_TANGENT_SENTENCE,
            "lens_covariance": {name: self.joint_of_lens(name) for name in self.lens_covariance},
            "frames_used": self.frames,
        }
        return {key: content[key] if key in content else getattr(self, key) for key in _KEYS}


_KEYS = (
    "format", "verdict", "summary", "camera_verdicts", "lidar_verdicts", "weaknesses",
    "error_sources", "frames", "T_camera_lidar", "sigmas", "error_bar_holds", "rig",
    "covariance_of", "covariance", "joint_names", "joint_covariance", "pair_covariance_of",
    "pair_covariance",
    "lens", "lens_covariance", "residuals", "counts", "frames_used",
    "moves", "motion", "places", "rounds", "warnings", "initial_rig",
    "stage1_T_camera_lidar", "terms", "config", "timings_s", "inputs", "versions", "date",
)  # fmt: skip
"""Of the file, in its order; those that are no attributes are made for it."""


def _verdict_mapping(verdicts: Mapping[str, Verdict]) -> dict[str, Any]:
    return {name: {**of.to_mapping(), "checks": of.checks} for name, of in verdicts.items()}


def _sigma_mapping(covariance: Array | None) -> dict[str, list[float]] | None:
    sigmas = [] if covariance is None else np.sqrt(np.diag(covariance)).tolist()
    return {"rotation_rad": sigmas[:3], "translation_m": sigmas[3:]} if sigmas else None
