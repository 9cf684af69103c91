"""The rows of the benchmark: what each way makes of one draw."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.errors import CorrespondenceError
from calibgraph.evaluation.baselines import oracle_solve, paper_solve, per_camera_adjustment
from calibgraph.evaluation.sources import Sample
from calibgraph.model.config import Config, Terms, preset
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.geometry import relative_transform
from calibgraph.model.rig import RelativePose, Rig
from calibgraph.solver.joint import solve_joint
from calibgraph.solver.objective import Transforms
from calibgraph.solver.preprocess import preprocess
from calibgraph.solver.stage1 import aggregate

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
RELATIVE = "ours (auto): full, relative pose known"
ORACLE = "oracle weights"
RELATIVE_SIGMA_RAD, RELATIVE_SIGMA_M = 1e-3, 2e-3
"""Noise, per axis, of the relative poses that are known from elsewhere; and what they say of it."""


@dataclass(frozen=True, eq=False)
class Bench:
    """One draw, preprocessed once, with its Stage 1, for all ways.

    Attributes:
        sample: the draw.
        theirs: the paper's settings.
        ours: our settings.
        seed: of the noise of the relative poses.
        table: what the preprocessing keeps with the paper's settings.
    """

    sample: Sample
    theirs: Config
    ours: Config
    seed: int
    table: Correspondences

    @staticmethod
    def of(sample: Sample, theirs: Config, seed: int) -> Bench:
        """Preprocess with the paper's settings; ours are those of the preset ``auto``."""
        ours = preset("auto").changed(stage1="rig" if sample.matched else "pnp", seed=theirs.seed)
        return Bench(sample, theirs, ours, seed, preprocess(sample.rig, sample.table, theirs).table)

    def aggregated(self, how: str) -> Transforms:
        """Per-frame PnP, aggregated over frames; the paper's Stage 1 is the median.

        Raises:
            CorrespondenceError: if PnP gave a camera no pose.
        """
        found = self.sample.stage1(self.theirs)
        for name in self.sample.rig.cameras:
            if name not in found or not len(found[name].per_frame):
                raise CorrespondenceError(f"PnP gives camera {name!r} no pose", camera=name)
        return {name: aggregate(found[name].per_frame, how) for name in self.sample.rig.cameras}

    def one_frame(self) -> Transforms:
        """PnP of the first frame that it gives a pose of."""
        _ = self.aggregated("median")  # there is one
        found = self.sample.stage1(self.theirs)
        return {name: camera.by_frame[min(camera.by_frame)] for name, camera in found.items()}

    def of_paper(self, terms: Terms) -> Transforms:
        """The paper's solver, from its Stage 1."""
        hat = self.aggregated("median")
        return paper_solve(self.sample.rig, self.table, hat, self.theirs, terms)

    def of_ours(self, terms: Terms, rig: Rig | None = None) -> Transforms:
        """Our solve with ``auto``, of the draw's rig or another."""
        known = None if self.ours.stage1 == "rig" else self.sample.stage1(self.ours)
        rig = rig or self.sample.rig
        return solve_joint(rig, self.sample.table, self.ours, terms, pairwise=known).T_camera_lidar

    def each_alone(self) -> Transforms:
        """Each camera alone, with the paper's scales."""
        known = self.sample.stage1(self.theirs)
        return per_camera_adjustment(
            self.sample.rig, self.sample.table, self.theirs, pairwise=known
        )

    def with_relative_poses(self) -> Transforms:
        """Ours, with independently known relative poses of neighbours, that err by their sigmas."""
        truth = next(iter(self.sample.references.values()))
        known = known_relative_poses(truth, self.seed)
        return self.of_ours("full", self.sample.rig.model_copy(update={"relative_poses": known}))

    def bound(self) -> Transforms:
        """With the weights that only the truth gives."""
        truth = self.sample.references["truth"].T_camera_lidar
        return oracle_solve(self.sample.rig, self.table, truth, self.ours)


def known_relative_poses(truth: Rig, seed: int) -> tuple[RelativePose, ...]:
    """Each camera with the next: the truth, with noise of 1 mrad and 2 mm per axis."""
    rng = np.random.default_rng([seed, 1])
    T = truth.T_camera_lidar
    pairs = []
    for a, b in pairwise(T):
        noise = np.eye(4)
        turn = RELATIVE_SIGMA_RAD * rng.standard_normal(3)
        noise[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
        noise[:3, 3] = RELATIVE_SIGMA_M * rng.standard_normal(3)
        T_a_b = noise @ relative_transform(T[a], T[b])
        pairs.append(RelativePose(a=a, b=b, T_a_b=T_a_b, rotation_sigma_rad=RELATIVE_SIGMA_RAD,
                                  translation_sigma_m=RELATIVE_SIGMA_M))  # fmt: skip
    return tuple(pairs)


Way = Callable[[Bench], Transforms]

WAYS: dict[str, Way] = {
    "PnP of one frame": Bench.one_frame,
    STAGE1: lambda bench: bench.aggregated("median"),
    "Stage 1: PnP, mean": lambda bench: bench.aggregated("mean"),
    "Stage 1: PnP, mode": lambda bench: bench.aggregated("mode"),
    **{row: partial(Bench.of_paper, terms=terms) for row, terms in TRF_TERMS.items()},
    "per-camera BA": Bench.each_alone,
    **{row: partial(Bench.of_ours, terms=terms) for row, terms in OUR_TERMS.items()},
    RELATIVE: Bench.with_relative_poses,
    ORACLE: Bench.bound,
}
"""The rows, in order."""


def run_all(bench: Bench, *, trf: bool) -> Iterator[tuple[str, Transforms | None, float]]:
    """Every row with its poses, None where it found none, and the seconds that it took.

    The Stage 1 that several rows share is computed before, and not in their seconds.
    """
    for config in (bench.theirs, bench.ours):
        if config.stage1 == "pnp":
            bench.sample.stage1(config)
    for row, way in WAYS.items():
        if (row in TRF_TERMS and not trf) or (row == ORACLE and not bench.sample.simulated):
            continue
        start = time.perf_counter()
        try:
            poses = way(bench)
        except CorrespondenceError:
            poses = None
        yield row, poses, time.perf_counter() - start
