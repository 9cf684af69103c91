"""Where the draws of an experiment come from: a simulated scenario, or matched recordings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from calibgraph.errors import CorrespondenceError, FileError
from calibgraph.io.dataset import Dataset, load_dataset
from calibgraph.io.kitti import CALIBRATION_NAME, read_kitti_rig
from calibgraph.io.rigs import REFERENCE_FILE, load_rig
from calibgraph.matching.structure import StructureMatcher
from calibgraph.model.config import Config, PresetName
from calibgraph.model.correspondences import Correspondences, concatenate
from calibgraph.model.perturbation import perturb
from calibgraph.model.rig import Rig
from calibgraph.progress import no_progress
from calibgraph.rounds import match_in_rounds
from calibgraph.simulation.scenarios import MAX_FRAMES, SCENARIOS, scenario_of
from calibgraph.solver.preprocess import preprocess
from calibgraph.solver.stage1 import Stage1, estimate_stage1

KITTI_PREFIX = "kitti:"


@dataclass(frozen=True)
class Displacement:
    """The displacement of every camera's guess from the truth: the paper's T_delta."""

    rotation_deg: float = 20.0
    translation_m: float = 1.5

    def guess(self, truth: Rig, seed: int) -> Rig:
        """T_init = T_delta T_GT: exactly this angle and length, random directions per camera."""
        return perturb(
            truth, rotation_deg=self.rotation_deg, translation_m=self.translation_m, seed=seed
        )


@dataclass(eq=False)
class Draw:
    """One draw: the input of the methods, and the references that they are compared with.

    Attributes:
        rig: lenses, and the guess; for recordings the estimate that the last round of matching
            started from.
        table: correspondences.
        references: rigs by name; never an input of a method.
        simulated: whether the first reference is the truth of a simulation.
        matched: whether the matcher estimates the extrinsics itself; our method then takes its
            estimate in place of Stage 1.
    """

    rig: Rig
    table: Correspondences
    references: Mapping[str, Rig]
    simulated: bool = True
    matched: bool = False
    _stage1: dict[float, Stage1] = field(default_factory=dict, init=False, repr=False)

    def stage1(self, config: Config) -> Stage1:
        """Stage 1 on the correspondences that pass these settings' filters, computed once.

        Of the settings that are compared here it depends on ``confidence_min`` alone.
        """
        key = config.confidence_min
        if key not in self._stage1:
            kept = preprocess(self.rig, self.table, config).table
            self._stage1[key] = estimate_stage1(self.rig, kept, config)
        return self._stage1[key]


class Source(Protocol):
    """Where draws come from; it is pickled for other processes.

    Attributes:
        name: for headings.
        preset: the paper's settings for such data.
        default_draws: number of draws that run in reasonable time.
        published_as: the paper's data set that it resembles: kitti, walkley or "".
    """

    @property
    def name(self) -> str: ...  # noqa: D102

    @property
    def preset(self) -> PresetName: ...  # noqa: D102

    @property
    def default_draws(self) -> int: ...  # noqa: D102

    @property
    def published_as(self) -> str: ...  # noqa: D102

    def frame_count(self, wanted: int) -> int:
        """The number of frames of a draw: as many as wanted, or all."""
        ...

    def draw(self, frames: int, seed: int) -> Draw:
        """That many frames and a new guess."""
        ...


@dataclass(frozen=True)
class Simulated:
    """A scenario by name: every draw is a new drive.

    Attributes:
        name: of the scenario.
        displacement: of the guesses.
    """

    name: str
    displacement: Displacement = Displacement()
    default_draws: int = field(default=50, init=False)

    @property
    def preset(self) -> PresetName:
        """``walkley`` for its scenario, ``kitti`` for all others."""
        return "walkley" if self.name == "walkley" else "kitti"

    @property
    def published_as(self) -> str:
        """The name of the scenario."""
        return self.name

    def frame_count(self, wanted: int) -> int:
        """As many as wanted.

        Raises:
            ValueError: if they do not fit into memory.
        """
        if wanted > MAX_FRAMES:
            raise ValueError(f"{wanted} frames: at most {MAX_FRAMES} can be simulated")
        return wanted

    def draw(self, frames: int, seed: int) -> Draw:
        """A new drive and a new guess."""
        scenario = scenario_of(self.name)
        drive_seed, guess_seed = _seeds(seed)
        rig = self.displacement.guess(scenario.rig, guess_seed)
        table = scenario.draw(self.frame_count(frames), drive_seed)
        return Draw(rig, table, {"truth": scenario.rig})


@dataclass(frozen=True)
class Recorded:
    """Recordings with a reference: matched again in every draw, from a new guess.

    Attributes:
        folders: dataset folder, or KITTI odometry sequences of one rig.
        displacement: of the guesses.
    """

    folders: tuple[Path, ...]
    displacement: Displacement = Displacement()
    preset: PresetName = field(default="kitti", init=False)
    default_draws: int = field(default=3, init=False)

    @property
    def name(self) -> str:
        """The names of the folders."""
        return "+".join(folder.name for folder in self.folders)

    @property
    def published_as(self) -> str:
        """``kitti`` for a KITTI sequence."""
        return "kitti" if (self.folders[0] / CALIBRATION_NAME).is_file() else ""

    @property
    def references(self) -> dict[str, Rig]:
        """For KITTI both interpretations of its ``calib.txt``, the right one first."""
        folder = self.folders[0]
        if (folder / CALIBRATION_NAME).is_file():
            return {
                "K^-1 P[:,3] (right)": read_kitti_rig(folder).rig,
                "P[0,3]/fx only": rig_shifted_along_x(folder),
            }
        if not (folder / REFERENCE_FILE).is_file():
            raise FileError(folder / REFERENCE_FILE, "no such file; a benchmark needs a reference")
        return {"reference": load_rig(folder / REFERENCE_FILE)}

    def frame_count(self, wanted: int) -> int:
        """At most all frames."""
        return min(wanted, len(self._dataset().frames))

    def draw(self, frames: int, seed: int) -> Draw:
        """A random subset of the frames, matched with ``structure`` from a new guess.

        The table is empty if the matcher finds nothing.
        """
        draw_seed, guess_seed = _seeds(seed)
        count = len(self._dataset().frames)
        chosen = np.random.default_rng(draw_seed).permutation(count)[: min(frames, count)]
        references = self.references
        rig = self.displacement.guess(next(iter(references.values())), guess_seed)
        data = load_dataset(self.folders, rig).select(",".join(map(str, np.sort(chosen))))
        try:
            run = match_in_rounds(
                data,
                rig,
                StructureMatcher(seed=draw_seed, most_frames=None),
                Config(seed=draw_seed),
                progress=no_progress,
            )
        except CorrespondenceError:
            empty = concatenate([_no_matches(name) for name in rig.cameras])
            return Draw(rig, empty, references, simulated=False, matched=True)
        return Draw(
            run.solution.rig, run.correspondences, references, simulated=False, matched=True
        )

    def _dataset(self) -> Dataset:
        return load_dataset(self.folders, next(iter(self.references.values())))


def rig_shifted_along_x(sequence: Path) -> Rig:
    """A KITTI rig as some tools read it: shifted by P[0, 3] / fx along x, about 5 mm off."""
    rig = read_kitti_rig(sequence).rig
    lines = (sequence / CALIBRATION_NAME).read_text("utf-8").splitlines()
    values = dict(line.split(":", 1) for line in lines if ":" in line)
    T_camera_lidar = {}
    for name, camera in rig.cameras.items():
        P = np.array(values[f"P{name[-1]}"].split(), dtype=np.float64).reshape(3, 4)
        T_along_right = np.eye(4)
        T_along_right[:3, 3] = -np.linalg.solve(P[:, :3], P[:, 3])
        T_along_right[0, 3] += P[0, 3] / P[0, 0]
        T_camera_lidar[name] = T_along_right @ camera.T_camera_lidar
    return rig.moved_to(T_camera_lidar)


def _no_matches(camera: str) -> Correspondences:
    return Correspondences.from_arrays(
        camera=camera, frame=0, pixels_px=np.empty((0, 2)), points_lidar_m=np.empty((0, 3))
    )


def _seeds(seed: int) -> tuple[int, int]:
    """Independent seeds of a draw's correspondences and of its guess."""
    state = np.random.SeedSequence([seed, 0]).generate_state(2)
    return int(state[0] >> 1), int(state[1] >> 1)


def source_from(data: str, displacement: Displacement | None = None) -> Source:
    """The source that the argument DATA names.

    Args:
        data: a scenario's name; a dataset folder with a ``reference.yaml``, or a KITTI odometry
            sequence; ``kitti:DIR,DIR``: KITTI sequences of one rig, as one recording.
        displacement: of the guesses; the paper's 20 deg and 1.5 m if None.

    Raises:
        ValueError: if it is none of these.
        FileError, DatasetError: if the data cannot be read.
    """
    displacement = displacement or Displacement()
    if data in SCENARIOS:
        return Simulated(data, displacement)
    folders = tuple(Path(part) for part in data.removeprefix(KITTI_PREFIX).split(",") if part)
    if not folders or not folders[0].is_dir():
        raise ValueError(
            f"{data!r} is no scenario ({', '.join(SCENARIOS)}), no folder, and no kitti:DIR,DIR"
        )
    source = Recorded(folders, displacement)
    source.frame_count(1)  # raises before the first draw if the data cannot be read
    return source
