"""Draws of the experiment, of a simulated scenario or of matched recordings, and its methods."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.paper.aggregates import aggregate
from benchmarks.paper.baselines import paper_solve
from calibgraph.errors import CorrespondenceError, FileError
from calibgraph.io.dataset import load_dataset
from calibgraph.io.kitti import CALIBRATION_NAME, read_kitti_rig
from calibgraph.io.rigs import REFERENCE_FILE, load_rig
from calibgraph.matching.structure import StructureMatcher
from calibgraph.model.config import Config, PresetName, Terms, preset
from calibgraph.model.correspondences import Correspondences, concatenate
from calibgraph.model.geometry import relative_transform
from calibgraph.model.perturbation import perturb
from calibgraph.model.rig import RelativePose, Rig
from calibgraph.progress import no_progress
from calibgraph.rounds import match_in_rounds
from calibgraph.simulation.scenarios import MAX_FRAMES, SCENARIOS, scenario_of
from calibgraph.solver.joint import solve_joint
from calibgraph.solver.objective import Transforms
from calibgraph.solver.preprocess import preprocess
from calibgraph.solver.stage1 import Stage1, estimate_stage1

KITTI_PREFIX = "kitti:"
STAGE1 = "Stage 1: PnP, median"
TRF_TERMS: dict[str, Terms] = {
    "paper (TRF): reprojection only": "reprojection",
    "paper (TRF): priors only": "priors",
    "paper (TRF): full": "full",
}
OUR_TERMS: dict[str, Terms] = {
    "ours (auto): Stage 1": "stage1",
    "ours (auto): reprojection only": "reprojection",
    "ours (auto): priors only": "priors",
    "ours (auto): full": "full",
}
HEADLINE = "ours (auto): full"
RELATIVE_SIGMA_RAD, RELATIVE_SIGMA_M = 1e-3, 2e-3
"""Noise per axis of the given relative poses, which state it as their sigmas."""


@dataclass(frozen=True)
class Source:
    """Where draws come from; it is pickled for other processes.

    Attributes:
        name: of a scenario, or those of the folders.
        folders: of recordings of one rig; none of a scenario.
        rotation_deg, translation_m: exact displacement of every guess, the paper's T_delta.
    """

    name: str
    folders: tuple[Path, ...] = ()
    rotation_deg: float = 20.0
    translation_m: float = 1.5

    @property
    def preset(self) -> PresetName:
        """The paper's settings for such data."""
        return "walkley" if self.name == "walkley" else "kitti"

    @property
    def published_as(self) -> str:
        """The paper's data set that it resembles."""
        of_kitti = bool(self.folders) and (self.folders[0] / CALIBRATION_NAME).is_file()
        return "kitti" if of_kitti else "" if self.folders else self.name

    def reference(self) -> Rig:
        """The truth of a scenario, the reference of recordings."""
        if not self.folders:
            return scenario_of(self.name).rig
        folder = self.folders[0]
        if (folder / CALIBRATION_NAME).is_file():
            return read_kitti_rig(folder).rig
        if not (folder / REFERENCE_FILE).is_file():
            raise FileError(folder / REFERENCE_FILE, "no such file; a benchmark needs a reference")
        return load_rig(folder / REFERENCE_FILE)

    def frame_count(self, wanted: int) -> int:
        """As many as wanted; of recordings at most all.

        Raises:
            ValueError: if so many do not fit into memory.
        """
        if self.folders:
            return min(wanted, len(load_dataset(self.folders, self.reference()).frames))
        if wanted > MAX_FRAMES:
            raise ValueError(f"{wanted} frames: at most {MAX_FRAMES} can be simulated")
        return wanted

    def draw(self, frames: int, seed: int) -> Draw:
        """A new drive, or a random subset of frames matched anew, from a new guess."""
        state = np.random.SeedSequence([seed, 0]).generate_state(2)
        own_seed, guess_seed = int(state[0] >> 1), int(state[1] >> 1)
        reference = self.reference()
        shift = {"rotation_deg": self.rotation_deg, "translation_m": self.translation_m}
        guess = perturb(reference, **shift, seed=guess_seed)
        if not self.folders:
            table = scenario_of(self.name).draw(self.frame_count(frames), own_seed)
            return Draw(guess, table, reference)
        data = load_dataset(self.folders, guess)
        count = len(data.frames)
        chosen = np.random.default_rng(own_seed).permutation(count)[: min(frames, count)]
        matcher = StructureMatcher(seed=own_seed, most_frames=None)
        data = data.select(",".join(map(str, np.sort(chosen))))
        config = Config(seed=own_seed)
        try:
            run = match_in_rounds(data, guess, matcher, config, progress=no_progress)
        except CorrespondenceError:  # every row fails
            empty = [_no_matches(name) for name in guess.cameras]
            return Draw(guess, concatenate(empty), reference, matched=True)
        return Draw(run.solution.rig, run.correspondences, reference, matched=True)


def _no_matches(camera: str) -> Correspondences:
    nothing = np.empty((0, 2)), np.empty((0, 3))
    return Correspondences.from_arrays(
        camera=camera, frame=0, pixels_px=nothing[0], points_lidar_m=nothing[1]
    )


def source_from(data: str, rotation_deg: float = 20.0, translation_m: float = 1.5) -> Source:
    """The source that the argument DATA names.

    Args:
        data: a scenario's name; a dataset folder with a ``reference.yaml``, or a KITTI odometry
            sequence; ``kitti:DIR,DIR``: KITTI sequences of one rig, as one recording.
        rotation_deg: of the guesses.
        translation_m: of the guesses.

    Raises:
        ValueError: if it is none of these.
        FileError, DatasetError: if the data cannot be read.
    """
    if data in SCENARIOS:
        return Source(data, (), rotation_deg, translation_m)
    folders = tuple(Path(part) for part in data.removeprefix(KITTI_PREFIX).split(",") if part)
    if not folders or not folders[0].is_dir():
        raise ValueError(
            f"{data!r} is no scenario ({', '.join(SCENARIOS)}), no folder, and no kitti:DIR,DIR"
        )
    name = "+".join(folder.name for folder in folders)
    source = Source(name, folders, rotation_deg, translation_m)
    source.frame_count(1)  # raises before the first draw if the data cannot be read
    return source


@dataclass(eq=False)
class Draw:
    """One draw: the input of the methods, and what they are compared with.

    Attributes:
        rig: lenses, and the guess; for recordings the estimate that the last round of matching
            started from.
        table: correspondences.
        reference: never an input of a method but for the relative poses that are known.
        matched: whether the matcher estimates the extrinsics itself; our method then takes its
            estimate in place of Stage 1.
    """

    rig: Rig
    table: Correspondences
    reference: Rig
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


@dataclass(frozen=True, eq=False)
class PreparedDraw:
    """One draw, preprocessed once for all methods.

    Attributes:
        draw: the draw.
        theirs, ours: the paper's settings and our own.
        seed: of the noise of the relative poses.
        table: what the preprocessing keeps with the paper's settings.
    """

    draw: Draw
    theirs: Config
    ours: Config
    seed: int
    table: Correspondences

    @staticmethod
    def prepare(draw: Draw, theirs: Config, seed: int) -> PreparedDraw:
        """Preprocess with the paper's settings; ours are those of the preset ``auto``."""
        ours = preset("auto").changed(stage1="rig" if draw.matched else "pnp", seed=theirs.seed)
        table = preprocess(draw.rig, draw.table, theirs).table
        return PreparedDraw(draw, theirs, ours, seed, table)

    def aggregate_pnp(self, how: str) -> Transforms:
        """Per-frame PnP, aggregated over frames; the paper's Stage 1 is the median.

        Raises:
            CorrespondenceError: if PnP finds no extrinsic of a camera.
        """
        found = self.draw.stage1(self.theirs)
        for name in self.draw.rig.cameras:
            if name not in found or not len(found[name].per_frame):
                raise CorrespondenceError(f"PnP finds no extrinsic of camera {name!r}", camera=name)
        if how == "first":
            return {name: one.by_frame[min(one.by_frame)] for name, one in found.items()}
        return {name: aggregate(found[name].per_frame, how) for name in self.draw.rig.cameras}

    def solve_as_paper(self, terms: Terms) -> Transforms:
        """The paper's solver, from its Stage 1."""
        hat = self.aggregate_pnp("median")
        return paper_solve(self.draw.rig, self.table, hat, self.theirs, terms)

    def solve_jointly(self, terms: Terms, rig: Rig | None = None) -> Transforms:
        """Our solve with the preset ``auto``, of the draw's rig or another one."""
        known = None if self.ours.stage1 == "rig" else self.draw.stage1(self.ours)
        rig = rig or self.draw.rig
        return solve_joint(rig, self.draw.table, self.ours, terms, pairwise=known).T_camera_lidar

    def solve_each_camera(self) -> Transforms:
        """Bundle adjustment of each camera alone, with the paper's scales."""
        known, rig, found = self.draw.stage1(self.theirs), self.draw.rig, {}
        for name, camera in rig.cameras.items():
            alone, own = (
                Rig(lidar=rig.lidar, cameras={name: camera}),
                self.draw.table.of_camera(name),
            )
            solved = solve_joint(alone, own, self.theirs, "reprojection", pairwise=known)
            found |= solved.T_camera_lidar
        return found

    def solve_with_relative_poses(self) -> Transforms:
        """Ours, with the relative poses of neighbours, which have noise of 1 mrad and 2 mm."""
        rng, pairs, T = (
            np.random.default_rng([self.seed, 1]),
            [],
            self.draw.reference.T_camera_lidar,
        )
        for a, b in pairwise(T):
            noise = np.eye(4)
            rotation = RELATIVE_SIGMA_RAD * rng.standard_normal(3)
            noise[:3, :3] = Rotation.from_rotvec(rotation).as_matrix()
            noise[:3, 3] = RELATIVE_SIGMA_M * rng.standard_normal(3)
            pairs.append(RelativePose(
                a=a, b=b, T_a_b=noise @ relative_transform(T[a], T[b]),
                rotation_sigma_rad=RELATIVE_SIGMA_RAD, translation_sigma_m=RELATIVE_SIGMA_M,
            ))  # fmt: skip
        rig = self.draw.rig.model_copy(update={"relative_poses": tuple(pairs)})
        return self.solve_jointly("full", rig)


METHODS: dict[str, Callable[[PreparedDraw], Transforms]] = {
    "PnP of one frame": partial(PreparedDraw.aggregate_pnp, how="first"),
    STAGE1: partial(PreparedDraw.aggregate_pnp, how="median"),
    "Stage 1: PnP, mean": partial(PreparedDraw.aggregate_pnp, how="mean"),
    "Stage 1: PnP, mode": partial(PreparedDraw.aggregate_pnp, how="mode"),
    **{row: partial(PreparedDraw.solve_as_paper, terms=terms) for row, terms in TRF_TERMS.items()},
    "per-camera BA": PreparedDraw.solve_each_camera,
    **{row: partial(PreparedDraw.solve_jointly, terms=terms) for row, terms in OUR_TERMS.items()},
    "ours (auto): full, relative pose known": PreparedDraw.solve_with_relative_poses,
}
"""The rows, in order."""


def run_methods(
    prepared: PreparedDraw, *, trf: bool
) -> Iterator[tuple[str, Transforms | None, float]]:
    """Every row with its T_camera_lidar, None if it failed, and its seconds.

    The Stage 1 that several rows share is computed first and not part of their seconds.
    """
    for config in (prepared.theirs, prepared.ours):
        if config.stage1 != "rig":
            prepared.draw.stage1(config)
    for row, method in METHODS.items():
        if row in TRF_TERMS and not trf:
            continue
        start = time.perf_counter()
        try:
            T_camera_lidar = method(prepared)
        except CorrespondenceError:
            T_camera_lidar = None
        yield row, T_camera_lidar, time.perf_counter() - start
