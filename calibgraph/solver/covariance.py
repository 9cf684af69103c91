"""An objective at extrinsics that fit it: its derivatives, covariances by frames and matches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.graph.objective import pose_key
from calibgraph.model.findings import error_components
from calibgraph.model.geometry import pose_rows
from calibgraph.solver.two_pass import Objective, Scales, Transforms, to_values
from factors import BlockSums, ProjectionBlock, to_runs


def convex_hessian(hessian: Array, otherwise: Array) -> Array:
    """The Hessian if it is positive definite; few matches near the gate may spoil it."""
    try:
        np.linalg.cholesky(hessian)
    except np.linalg.LinAlgError:
        return otherwise
    return hessian


def positive_part(matrix: Array) -> Array:
    """The positive semidefinite matrix nearest to a symmetric one."""
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def pose_equations(
    graph: gtsam.NonlinearFactorGraph, cameras: Sequence[str], T_camera_lidar: Mapping[str, Array]
) -> tuple[Array, Array]:
    """(6 N, 6 N) Gauss-Newton Hessian and (6 N,) gradient of the factors between poses."""
    hessian, gradient = np.zeros((6 * len(cameras), 6 * len(cameras))), np.zeros(6 * len(cameras))
    keys, present = [pose_key(cameras, name) for name in cameras], {*graph.keyVector()}
    numbers = [number for number, key in enumerate(keys) if key in present]
    if numbers:
        linear = graph.linearize(to_values(cameras, T_camera_lidar))
        own = linear.hessian(gtsam.Ordering([keys[number] for number in numbers]))
        rows = np.concatenate([np.r_[pose_rows(number)] for number in numbers])
        hessian[np.ix_(rows, rows)], gradient[rows] = own[0], -own[1]
    return hessian, gradient


@dataclass(frozen=True, eq=False)
class FittedObjective:
    """An objective, its scales, and the extrinsics where it is examined.

    Attributes:
        objective: after the gate.
        scales: of the residuals.
        T_camera_lidar: (4, 4) of all cameras: its minimum.
        held: cameras that nothing determines; they are known to a radian and a metre.
    """

    objective: Objective
    scales: Scales
    T_camera_lidar: Transforms
    held: tuple[str, ...] = ()

    @property
    def cameras(self) -> tuple[str, ...]:
        """Their names, in the order of the extrinsics."""
        return tuple(self.T_camera_lidar)

    @cached_property
    def projections(self) -> Mapping[str, ProjectionBlock]:
        """Per camera with correspondences, these with their scale."""
        return {n: b.with_scale(self.scales[n]) for n, b in self.objective.blocks.items()}

    @cached_property
    def frame_sums(self) -> Mapping[str, BlockSums]:
        """Per camera with correspondences, the sums of its frames; empty without terms."""
        if not self.objective.uses_correspondences:
            return {}
        T, blocks = self.T_camera_lidar, self.objective.blocks
        edges = {name: block.frame_edges for name, block in blocks.items()}
        return {
            name: block.summarize(T[name][None], to_runs(edges[name]), curvature=True)
            for name, block in self.projections.items()
        }

    @cached_property
    def robust_hessians(self) -> Mapping[str, Array]:
        """Per camera, (6, 6) second derivative of half its robust cost; H if that is not convex."""
        return {
            name: convex_hessian(sums.curvature.sum(axis=0), sums.hessian.sum(axis=0))
            for name, sums in self.frame_sums.items()
            if sums.curvature is not None
        }

    def data_only(self) -> FittedObjective:
        """The correspondences alone, at their minimum near here."""
        free = self.objective.data_only()
        start = {name: self.T_camera_lidar[name] for name in free.cameras}
        return FittedObjective(free, self.scales, free.minimize(start, self.scales).T_camera_lidar)


ENOUGH_FRAMES = 5
"""From so many on, the scatter between frames decides about the error bar; with fewer, mostly what
is usual of matches."""

PSEUDO_FRAMES = error_components().pseudo_frames
"""Frames that are added with the scatter along each principal direction. A covariance of six
numbers from few frames is too small for their joint error (its inverse, by (F - 1) / (F - 8) for F
frames)."""


def with_pseudo_frames(
    scatter: Array, hessian: Array, frames: float, usual: Array | None = None
) -> Array:
    """The scatter of the frames' gradients, with an allowance for few frames.

    All frames determine the scatter along each eigenvector of the Hessian, but its correlations
    between eigenvectors much less well. So the scatter without correlations is added as that of
    PSEUDO_FRAMES further frames. Along each eigenvector, what is usual counts as half a frame: next
    to nothing where there are many frames, alone where there is one. Over draws of 5 to 30 frames,
    with errors shared by a frame or not, the normalised squared error over 6 is 0.6 to 1.1; with 1
    to 3 frames 0.8 to 1.1 where half of a match's variance is shared by its frame, less elsewhere.

    Args:
        scatter: (..., n, n) sum over frames of the outer products of their gradients.
        hessian: (..., n, n).
        frames: their number.
        usual: (n, n) the scatter that is usual for as many frames; None if nothing is known.
    """
    vectors = np.linalg.eigh(hessian)[1]
    count = max(frames, 1.0)
    along = _along(vectors, scatter) / count
    if usual is None:
        mean = along * count / max(count - 1.0, 1.0)
    else:
        prior = _along(vectors, usual) / (count * PSEUDO_FRAMES)
        prior_frames = error_components().prior_frames
        mean = (prior_frames * prior + count * along) / (prior_frames + count - 1.0)
    spread = vectors * (PSEUDO_FRAMES * mean)[..., None, :]
    return np.asarray(scatter + spread @ vectors.swapaxes(-1, -2))


def _along(vectors: Array, matrix: Array) -> Array:
    """(..., n) v^T M v of each column v."""
    return np.asarray((vectors * (matrix @ vectors)).sum(axis=-2))
