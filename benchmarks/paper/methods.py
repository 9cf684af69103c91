"""The rows of the experiment: every method, applied to one draw."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.paper.baselines import oracle_solve, paper_solve, per_camera_adjustment
from benchmarks.paper.sources import Draw
from calibgraph.errors import CorrespondenceError
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
"""Noise per axis of the given relative poses, which state it as their sigmas."""


@dataclass(frozen=True, eq=False)
class PreparedDraw:
    """One draw, preprocessed once for all methods.

    Attributes:
        draw: the draw.
        theirs: the paper's settings.
        ours: our settings.
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
        return {name: aggregate(found[name].per_frame, how) for name in self.draw.rig.cameras}

    def pnp_of_first_frame(self) -> Transforms:
        """PnP of the first frame in which it succeeds."""
        self.aggregate_pnp("median")  # raises if there is none
        found = self.draw.stage1(self.theirs)
        return {name: camera.by_frame[min(camera.by_frame)] for name, camera in found.items()}

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
        """Each camera alone, with the paper's scales."""
        known = self.draw.stage1(self.theirs)
        return per_camera_adjustment(self.draw.rig, self.draw.table, self.theirs, pairwise=known)

    def solve_with_relative_poses(self) -> Transforms:
        """Ours, with given relative poses of neighbouring cameras, with noise of their sigmas."""
        truth = next(iter(self.draw.references.values()))
        known = known_relative_poses(truth, self.seed)
        return self.solve_jointly(
            "full", self.draw.rig.model_copy(update={"relative_poses": known})
        )

    def solve_with_oracle_weights(self) -> Transforms:
        """The reprojection term with weights computed from the truth."""
        truth = self.draw.references["truth"].T_camera_lidar
        return oracle_solve(self.draw.rig, self.table, truth, self.ours)


def known_relative_poses(truth: Rig, seed: int) -> tuple[RelativePose, ...]:
    """Of each camera with the next: the truth, with noise of 1 mrad and 2 mm per axis."""
    rng = np.random.default_rng([seed, 1])
    T = truth.T_camera_lidar
    pairs = []
    for a, b in pairwise(T):
        noise = np.eye(4)
        rotation = RELATIVE_SIGMA_RAD * rng.standard_normal(3)
        noise[:3, :3] = Rotation.from_rotvec(rotation).as_matrix()
        noise[:3, 3] = RELATIVE_SIGMA_M * rng.standard_normal(3)
        T_a_b = noise @ relative_transform(T[a], T[b])
        pairs.append(RelativePose(a=a, b=b, T_a_b=T_a_b, rotation_sigma_rad=RELATIVE_SIGMA_RAD,
                                  translation_sigma_m=RELATIVE_SIGMA_M))  # fmt: skip
    return tuple(pairs)


Method = Callable[[PreparedDraw], Transforms]

METHODS: dict[str, Method] = {
    "PnP of one frame": PreparedDraw.pnp_of_first_frame,
    STAGE1: partial(PreparedDraw.aggregate_pnp, how="median"),
    "Stage 1: PnP, mean": partial(PreparedDraw.aggregate_pnp, how="mean"),
    "Stage 1: PnP, mode": partial(PreparedDraw.aggregate_pnp, how="mode"),
    **{row: partial(PreparedDraw.solve_as_paper, terms=terms) for row, terms in TRF_TERMS.items()},
    "per-camera BA": PreparedDraw.solve_each_camera,
    **{row: partial(PreparedDraw.solve_jointly, terms=terms) for row, terms in OUR_TERMS.items()},
    RELATIVE: PreparedDraw.solve_with_relative_poses,
    ORACLE: PreparedDraw.solve_with_oracle_weights,
}
"""The rows, in order."""


def run_methods(
    prepared: PreparedDraw, *, trf: bool
) -> Iterator[tuple[str, Transforms | None, float]]:
    """Every row with its T_camera_lidar, None if it failed, and its seconds.

    The Stage 1 that several rows share is computed first and not part of their seconds.

    Args:
        prepared: the draw.
        trf: whether to run the paper's solver.
    """
    for config in (prepared.theirs, prepared.ours):
        if config.stage1 != "rig":
            prepared.draw.stage1(config)
    for row, method in METHODS.items():
        if (row in TRF_TERMS and not trf) or (row == ORACLE and not prepared.draw.simulated):
            continue
        start = time.perf_counter()
        try:
            T_camera_lidar = method(prepared)
        except CorrespondenceError:
            T_camera_lidar = None
        yield row, T_camera_lidar, time.perf_counter() - start
