"""The gate of a camera's matches, and the sums of those within."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from calibgraph.arrays import Array, Mask
from calibgraph.graph.objective import projection_graph
from calibgraph.model.config import Config
from calibgraph.model.geometry import invert
from calibgraph.solver.matches import MIN_MATCHES, CameraBlock
from calibgraph.solver.pnp import frame_pose
from calibgraph.solver.robust import ResidualScale
from calibgraph.solver.two_pass import optimize
from calibgraph.solver.within_place import WEAK
from calibgraph.tracking.state import OutlierFrame, State
from calibgraph.tracking.sums import Sums
from factors import BlockSums, to_runs
from factors.pose_kernel import logarithms

_AGREEMENT = 0.7
"""A frame agrees with an estimate that explains this share of the usual share of its matches."""
_CURVATURES = 0.3, 1.0
"""Of the true Hessian, in units of the one by weights; usually 0.6 to 0.9."""


@dataclass(frozen=True, eq=False)
class Gated:
    """Frames of a camera, and which of their matches are within the gate.

    Attributes:
        poses: (1, 4, 4) T_camera_lidar, or (f, 4, 4) of each, where they are linearized.
        raw: all their matches.
        inliers: (m,) which of them are within the gate.
        counts: (f,) how many are, in each frame.
    """

    poses: Array
    raw: CameraBlock
    inliers: Mask
    counts: Array

    @staticmethod
    def at(T_camera_lidar: Array, raw: CameraBlock, scale: ResidualScale) -> Gated:
        """Gate all matches of some frames."""
        inliers = raw.within_gate(T_camera_lidar, scale.gate_px)
        counts = np.add.reduceat(inliers, raw.frame_edges[:-1], dtype=np.float64)
        return Gated(T_camera_lidar[None], raw, inliers, counts)

    @property
    def usual_share(self) -> float:
        """Median over the frames of the share of their matches within the gate."""
        return float(np.median(self.counts / self.raw.frame_counts))

    @property
    def enough(self) -> Mask:
        """(f,) whether a frame has enough matches within the gate to be absorbed."""
        return np.asarray(self.counts >= MIN_MATCHES)

    def agree(self, state: State, camera: int) -> Mask:
        """(f,) whether the pose explains about the usual share of each frame's matches."""
        least = _AGREEMENT * state.share[camera] * self.raw.frame_counts
        return np.asarray(self.enough & (self.counts >= least))

    def select(self, frames: Mask) -> Gated:
        """Some of the frames."""
        if frames.all():
            return self
        rows = np.flatnonzero(np.repeat(frames, self.raw.frame_counts))
        raw = self.raw.select(rows)
        return Gated(self.poses, raw, self.inliers[rows], self.counts[frames])

    def curvature(self, scale: ResidualScale) -> Array:
        """(6, 6) M: with the Hessian by weights L L^T, the true one is L M L^T, of all inliers.

        With what the gate's moving with the extrinsic adds.
        """
        runs = np.array([[0, int(self.counts.sum())]])
        block = self.raw.with_scale(scale).select(self.inliers)
        here = block.summarize(self.poses, runs, curvature=True)
        assert here.curvature is not None
        true = here.curvature[0] + self.raw.gate_hessian(self.poses[0], scale)
        inverse = np.linalg.inv(np.linalg.cholesky(here.hessian[0] + WEAK))
        values, vectors = np.linalg.eigh(inverse @ true @ inverse.T)
        return np.asarray((vectors * np.clip(values, *_CURVATURES)) @ vectors.T)


def sums_of(state: State, gated: Mapping[int, Gated]) -> Sums:
    """(f,) sums of the inliers in the frames of each camera in turn, about its reference.

    The true Hessian of few matches is noise, and may not be definite: its ratio to the one by
    weights is that of all frames.

    Args:
        state: with the scales of the residuals, and how curved their cost is.
        gated: by camera; linearized at its poses.
    """
    parts, at, cameras = [], [], list[int]()
    for camera, one in gated.items():
        edges = np.concatenate([[0], one.counts.cumsum().astype(np.int64)])
        block = one.raw.with_scale(state.scales[camera]).select(one.inliers)
        parts.append(block.summarize(one.poses, to_runs(edges)))
        at.append(np.broadcast_to(one.poses, (len(one.counts), 4, 4)))
        cameras += [camera] * len(one.counts)
    here, poses, to = BlockSums.join(parts), np.concatenate(at), state.references
    root = np.linalg.cholesky(here.hessian + WEAK)
    hessian = root @ state.curvature[cameras] @ root.swapaxes(1, 2)
    gradient = here.gradient
    if not np.array_equal(poses, to[cameras]):
        steps = logarithms(poses @ invert(to[cameras]))
        gradient = gradient + (hessian @ steps[..., None])[..., 0]
    return Sums.of(
        hessian=hessian,
        gradient=gradient,
        reweighted=here.hessian,
        score=gradient,
        scatter=gradient[:, :, None] * gradient[:, None, :],
        frames=np.ones(len(cameras)),
        matches=np.concatenate([one.counts for one in gated.values()]),
    )


def find_outlier_frame(state: State, camera: int, raw: CameraBlock) -> OutlierFrame | None:
    """A frame with its own T_camera_lidar; None if none explains it, so the matching failed."""
    for start in _starts(state, camera, raw):
        T_own = refine(raw, start, state.scales[camera], state.config)
        if agrees(state, camera, raw, T_own):
            return OutlierFrame(int(raw.frame[0]), raw, T_own)
    return None


def agrees(state: State, camera: int, raw: CameraBlock, T_camera_lidar: Array) -> bool:
    """Whether a T_camera_lidar explains about the usual share of a frame's matches."""
    return bool(Gated.at(T_camera_lidar, raw, state.scales[camera]).agree(state, camera).all())


def _starts(state: State, camera: int, raw: CameraBlock) -> Iterator[Array]:
    """Start values for the frame's own T_camera_lidar: the estimate; then PnP, if possible.

    PnP takes several times as long as a fit from the estimate, which is mostly near enough. Both
    end at the same minimum where most of the usual share of matches agrees.
    """
    yield state.references[camera]
    if raw.information is not None or state.config.stage1 == "rig":
        return
    by_pnp = frame_pose(state.rig.cameras[state.names[camera]], raw.block, state.config)
    if by_pnp is not None:
        yield by_pnp


def refine(raw: CameraBlock, start: Array, scale: ResidualScale, config: Config) -> Array:
    """The T_camera_lidar that fits a camera's matches, with a wide loss first."""
    T = start
    widening = max(config.pnp_threshold_px / scale.gate_px, 1.0)
    for factor in (widening, 1.0):
        wide = ResidualScale(
            scale.sigma, scale.loss_scale * factor, scale.gate_px * factor, scale.sigma_px
        )
        inliers = raw.without_outliers(T, wide)
        if len(inliers.frame) < MIN_MATCHES:
            return start
        graph = projection_graph(["camera"], {"camera": inliers.with_scale(wide)})
        T = optimize(graph, ["camera"], {"camera": T}).T_camera_lidar["camera"]
    return T
