"""The gate of a camera's matches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calibgraph.arrays import Array, Mask
from calibgraph.model.config import Config
from calibgraph.solver.matches import MIN_MATCHES, CameraBlock, merge
from calibgraph.solver.robust import ResidualScale
from calibgraph.solver.two_pass import RELATIVE_TOLERANCE
from calibgraph.solver.within_place import WEAK
from factors import to_runs

_AGREEMENT = 0.7
"""A frame agrees with an estimate that explains this share of the usual share of its matches."""
_CURVATURES = 0.3, 1.0
"""Of the true Hessian, in units of the one by weights; usually 0.6 to 0.9."""


@dataclass(frozen=True, eq=False)
class Gated:
    """Frames of a camera, and which of their matches are within the gate.

    Attributes:
        raw: all their matches.
        inliers: (m,) which of them are within the gate.
        poses: (f, 4, 4) T_camera_lidar of each frame, at which it is gated.
    """

    raw: CameraBlock
    inliers: Mask
    poses: Array

    @staticmethod
    def at(T_camera_lidar: Array, raw: CameraBlock, scale: ResidualScale) -> Gated:
        """Gate all matches of some frames at one pose."""
        inliers = raw.within_gate(T_camera_lidar, scale.gate_px)
        return Gated(raw, inliers, T_camera_lidar[None].repeat(raw.frames, axis=0))

    @staticmethod
    def join(parts: Sequence[Gated]) -> Gated:
        """The frames of some, in the order given."""
        if len(parts) == 1:
            return parts[0]
        return Gated(
            merge([part.raw for part in parts]),
            np.concatenate([part.inliers for part in parts]),
            np.concatenate([part.poses for part in parts]),
        )

    @property
    def number(self) -> int:
        """Number of the first frame."""
        return int(self.raw.frame[0])

    @cached_property
    def counts(self) -> Array:
        """(f,) how many matches of each frame are within the gate."""
        return np.add.reduceat(self.inliers, self.raw.frame_edges[:-1], dtype=np.float64)

    @cached_property
    def inside(self) -> CameraBlock:
        """The matches within the gate."""
        return self.raw.select(self.inliers)

    @property
    def usual_share(self) -> float:
        """Median over the frames of the share of their matches within the gate."""
        return float(np.median(self.counts / self.raw.frame_counts))

    @property
    def enough(self) -> Mask:
        """(f,) whether a frame has enough matches within the gate to be absorbed."""
        return np.asarray(self.counts >= MIN_MATCHES)

    def agrees(self, usual_share: float) -> bool:
        """Whether the pose explains about the usual share of the matches of every frame."""
        least = np.maximum(_AGREEMENT * usual_share * self.raw.frame_counts, MIN_MATCHES)
        return bool((self.counts >= least).all())

    def select(self, frames: Mask) -> Gated:
        """Some of the frames."""
        if frames.all():
            return self
        rows = np.flatnonzero(np.repeat(frames, self.raw.frame_counts))
        return Gated(self.raw.select(rows), self.inliers[rows], self.poses[frames])

    def curvature(self, T_camera_lidar: Array, scale: ResidualScale) -> Array:
        """(6, 6) M: with the Hessian by weights L L^T, the true one is L M L^T, of all inliers.

        With what the gate's moving with the extrinsic adds.
        """
        here = self.inside.with_scale(scale).summarize(T_camera_lidar[None], curvature=True)
        assert here.curvature is not None
        true = here.curvature[0] + self.raw.gate_hessian(T_camera_lidar, scale)
        inverse = np.linalg.inv(np.linalg.cholesky(here.hessian[0] + WEAK))
        values, vectors = np.linalg.eigh(inverse @ true @ inverse.T)
        return np.asarray((vectors * np.clip(values, *_CURVATURES)) @ vectors.T)


def refine(raw: CameraBlock, start: Array, scale: ResidualScale, config: Config) -> Array:
    """The T_camera_lidar that fits a camera's matches, with a wide loss first."""
    T = start
    widening = max(config.pnp_threshold_px / scale.gate_px, 1.0)
    for factor in (widening, 1.0):
        gate_px, loss_scale = scale.gate_px * factor, scale.loss_scale * factor
        wide = replace(scale, gate_px=gate_px, loss_scale=loss_scale)
        inliers = raw.without_outliers(T, wide)
        if len(inliers) < MIN_MATCHES:
            return start
        runs = to_runs(np.array([0, len(inliers)]))
        T = inliers.with_scale(wide).fit(T[None], runs, tolerance=RELATIVE_TOLERANCE)[0][0]
    return T
