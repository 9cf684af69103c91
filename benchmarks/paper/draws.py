"""Draws of the experiment, of a simulated scenario or of matched recordings, and its methods."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.paper.aggregates import aggregate
from benchmarks.paper.baselines import paper_solve
from benchmarks.paper.scenarios import SCENARIOS, draw_scenario
from calibgraph.errors import CorrespondenceError
from calibgraph.io.dataset import load_dataset
from calibgraph.io.kitti import CALIBRATION_NAME
from calibgraph.io.rigs import REFERENCE_FILE, load_rig
from calibgraph.matching.structure import StructureMatcher
from calibgraph.model.config import Config, PresetName, Terms, preset
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.geometry import relative_transform, transform
from calibgraph.model.metrics import perturb
from calibgraph.model.rig import RelativePose, Rig
from calibgraph.progress import no_progress
from calibgraph.rounds import match_in_rounds
from calibgraph.simulation.rigs import rig_of
from calibgraph.solver.joint import solve_joint
from calibgraph.solver.matches import camera_blocks
from calibgraph.solver.preprocess import preprocess
from calibgraph.solver.stage1 import Stage1, estimate_stage1
from calibgraph.solver.two_pass import Transforms

GUESS_DEG, GUESS_M = 20.0, 1.5
"""Exact displacement of every guess, the paper's T_delta."""
KITTI_PREFIX = "kitti:"
STAGE1 = "Stage 1: PnP, median"
_TERMS: dict[str, Terms] = {
    "reprojection only": "reprojection", "priors only": "priors", "full": "full",
}  # fmt: skip
TRF_TERMS = {f"paper (TRF): {name}": terms for name, terms in _TERMS.items()}
OUR_TERMS: dict[str, Terms] = {"ours (auto): Stage 1": "stage1"}
OUR_TERMS |= {f"ours (auto): {name}": terms for name, terms in _TERMS.items()}
HEADLINE = "ours (auto): full"
RELATIVE_SIGMA_RAD, RELATIVE_SIGMA_M = 1e-3, 2e-3
"""Noise per axis of the given relative poses, which state it as their sigmas."""


@dataclass(frozen=True)
class Source:
    """Where draws come from; it is pickled for other processes.

    Attributes:
        name: of a scenario, or those of the folders.
        folders: of recordings of one rig; none of a scenario.
    """

    name: str
    folders: tuple[Path, ...] = ()

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
            return rig_of(self.name)
        own = self.folders[0] / REFERENCE_FILE
        return load_rig(own if own.is_file() else self.folders[0])

    def frame_count(self, wanted: int) -> int:
        """As many as wanted; of recordings at most all."""
        if not self.folders:
            return wanted
        return min(wanted, len(load_dataset(self.folders, self.reference()).frames))

    def draw(self, frames: int, seed: int, theirs: Config) -> Draw:
        """A new drive, or a random subset of frames matched anew, from a new guess.

        Raises:
            CorrespondenceError: if the matcher finds nothing.
        """
        state = np.random.SeedSequence([seed, 0]).generate_state(2)
        own_seed, guess_seed = int(state[0] >> 1), int(state[1] >> 1)
        reference = self.reference()
        guess = perturb(reference, rotation_deg=GUESS_DEG, translation_m=GUESS_M, seed=guess_seed)
        if not self.folders:
            table = draw_scenario(self.name, frames, own_seed)
            return Draw(guess, table, reference, theirs, seed)
        data = load_dataset(self.folders, guess)
        count = len(data.frames)
        chosen = np.random.default_rng(own_seed).permutation(count)[: min(frames, count)]
        matcher = StructureMatcher(seed=own_seed, most_frames=None)
        data = data.select(",".join(map(str, np.sort(chosen))))
        run = match_in_rounds(data, guess, matcher, Config(seed=own_seed), progress=no_progress)
        rig = run.solution.rig
        return Draw(rig, run.correspondences, reference, theirs, seed, matched=True)


def source_from(data: str) -> Source:
    """The source that the argument DATA of the command names.

    Raises:
        ValueError, CalibrationError: if it is none, or cannot be read.
    """
    if data in SCENARIOS:
        return Source(data)
    folders = tuple(Path(part) for part in data.removeprefix(KITTI_PREFIX).split(",") if part)
    if not folders or not folders[0].is_dir():
        raise ValueError(
            f"{data!r} is no scenario ({', '.join(SCENARIOS)}), no folder, and no kitti:DIR,DIR"
        )
    name = "+".join(folder.name for folder in folders)
    source = Source(name, folders)
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
        theirs: the paper's settings; ours are the preset ``auto``.
        seed: of the noise of the relative poses.
        matched: whether the matcher estimates the extrinsics itself; our method then takes its
            estimate in place of Stage 1.
    """

    rig: Rig
    table: Correspondences
    reference: Rig
    theirs: Config
    seed: int
    matched: bool = False
    _stage1: dict[float, Stage1] = field(default_factory=dict, init=False, repr=False)

    @property
    def ours(self) -> Config:
        """Our settings."""
        return preset("auto").changed(
            stage1="rig" if self.matched else "pnp", seed=self.theirs.seed
        )

    @cached_property
    def kept(self) -> Correspondences:
        """What the preprocessing keeps with the paper's settings."""
        return preprocess(self.rig, self.table, self.theirs).table

    def stage1(self, config: Config) -> Stage1:
        """Stage 1 on the correspondences that pass these settings' filters, computed once.

        Of the settings that are compared here it depends on ``confidence_min`` alone.
        """
        key = config.confidence_min
        if key not in self._stage1:
            kept = preprocess(self.rig, self.table, config).table
            blocks = camera_blocks(self.rig, kept, config)
            self._stage1[key] = estimate_stage1(self.rig, blocks, config)
        return self._stage1[key]

    def aggregate_pnp(self, how: str) -> Transforms:
        """Per-frame PnP, aggregated over frames; the paper's Stage 1 is the median.

        Raises:
            CorrespondenceError: if PnP finds no extrinsic of a camera.
        """
        found = self.stage1(self.theirs)
        for name in self.rig.cameras:
            if name not in found or not len(found[name].per_frame):
                raise CorrespondenceError(f"PnP finds no extrinsic of camera {name!r}", camera=name)
        if how == "first":
            return {name: one.by_frame[min(one.by_frame)] for name, one in found.items()}
        return {name: aggregate(found[name].per_frame, how) for name in self.rig.cameras}

    def solve_as_paper(self, terms: Terms) -> Transforms:
        """The paper's solver, from its Stage 1."""
        return paper_solve(self.rig, self.kept, self.aggregate_pnp("median"), self.theirs, terms)

    def solve_jointly(self, terms: Terms, rig: Rig | None = None) -> Transforms:
        """Our solve with the preset ``auto``, of the draw's rig or another one."""
        known = None if self.matched else self.stage1(self.ours)
        solved = solve_joint(rig or self.rig, self.table, self.ours, terms, pairwise=known)
        return solved.T_camera_lidar

    def solve_each_camera(self) -> Transforms:
        """Bundle adjustment of each camera alone, with the paper's scales."""
        known, found = self.stage1(self.theirs), Transforms()
        for name, camera in self.rig.cameras.items():
            alone = Rig(lidar=self.rig.lidar, cameras={name: camera})
            own = self.table.of_camera(name)
            solved = solve_joint(alone, own, self.theirs, "reprojection", pairwise=known)
            found |= solved.T_camera_lidar
        return found

    def solve_with_relative_poses(self) -> Transforms:
        """Ours, with the relative poses of neighbours, which have noise of 1 mrad and 2 mm."""
        rng, pairs = np.random.default_rng([self.seed, 1]), []
        T = self.reference.T_camera_lidar
        for a, b in pairwise(T):
            rotation = Rotation.from_rotvec(RELATIVE_SIGMA_RAD * rng.standard_normal(3))
            noise = transform(rotation, RELATIVE_SIGMA_M * rng.standard_normal(3))
            pairs.append(RelativePose(
                a=a, b=b, T_a_b=noise @ relative_transform(T[a], T[b]),
                rotation_sigma_rad=RELATIVE_SIGMA_RAD, translation_sigma_m=RELATIVE_SIGMA_M,
            ))  # fmt: skip
        rig = self.rig.model_copy(update={"relative_poses": tuple(pairs)})
        return self.solve_jointly("full", rig)


METHODS: dict[str, Callable[[Draw], Transforms]] = {
    "PnP of one frame": partial(Draw.aggregate_pnp, how="first"),
    STAGE1: partial(Draw.aggregate_pnp, how="median"),
    "Stage 1: PnP, mean": partial(Draw.aggregate_pnp, how="mean"),
    "Stage 1: PnP, mode": partial(Draw.aggregate_pnp, how="mode"),
    **{row: partial(Draw.solve_as_paper, terms=terms) for row, terms in TRF_TERMS.items()},
    "per-camera BA": Draw.solve_each_camera,
    **{row: partial(Draw.solve_jointly, terms=terms) for row, terms in OUR_TERMS.items()},
    "ours (auto): full, relative pose known": Draw.solve_with_relative_poses,
}
"""The rows, in order."""


def run_methods(draw: Draw, *, trf: bool) -> Iterator[tuple[str, Transforms | None, float]]:
    """Every row with its T_camera_lidar, None if it failed, and its seconds.

    The Stage 1 that several rows share is computed first and not part of their seconds.
    """
    _ = draw.kept
    for config in (draw.theirs, draw.ours):
        if config.stage1 != "rig":
            draw.stage1(config)
    for row, method in METHODS.items():
        if row in TRF_TERMS and not trf:
            continue
        start = time.perf_counter()
        try:
            T_camera_lidar = method(draw)
        except CorrespondenceError:
            T_camera_lidar = None
        yield row, T_camera_lidar, time.perf_counter() - start
