"""Frames that a matcher saw wrongly, and how much the others are worth: weights from residuals.

The matches of one frame share errors: a learned matcher that stops short moves all of them, and
thousands of matches then agree on a wrong pose. So frames are random effects: each has a pose of
its own, which scatters about the camera's. A frame counts by the spread of its matches about its
own pose and by that scatter, whatever the number of its matches; frames far from where frames are
densest do not count at all. Confidences are turned into standard deviations by what they are worth.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from calibgraph.model.correspondences import Correspondences
from calibgraph.model.geometry import to_T_camera_lidar, to_T_lidar_camera
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.residual_scale import CAUCHY_SCALE_SIGMAS, robust_spread
from calibgraph.solver.stage1 import Stage1

Array = NDArray[np.float64]

MIN_FRAMES = 8  # of fewer, frames say too little of each other: weights would flatter the error bar
_OWN_STEPS = 6  # towards a frame's own pose
_MAX_TURN_RAD = 0.05  # per step
_DAMPING = 1e-6  # of a frame that leaves a direction free

# Chosen on simulated drives of the paper's two rigs, other ones than those that are reported.
_NEAREST_SHARE = 0.15  # of the frames, whose distance is the unit of nearness
_NARROW = 3.0  # units of reach while where frames are densest is looked for
_REACH = 4.0  # units from there at which a frame does not count any more
_ALONE = 4.0  # times farther off: the third of three frames does not belong to the two
_FLAT = 2.0  # frames count in full up to half the reach
_WIDER = 2.2  # nearness to spread: the median of a Rayleigh law over its quantile of that share
_MOVING_STEPS, _STEPS = 5, 15  # of the mean shift: looking, and in all
_CANDIDATES = 200  # where to start looking
_MOST = 1e6  # of a spread: a frame that is all behind its camera has none
_SETTLED = 1e-6  # rad, m
_CONFIDENCE_BINS, _BIN_MATCHES = 20, 100
_TOLD_BY = 10  # matches: of fewer, their residuals about their own pose tell no spread
_CHANCE = 2.0  # times what noise moves a frame's pose by, in mean squares: rarely more (5 %)
_LEAST_SIZE = 0.05  # of a frame's spread, which is not below MIN_SIGMA_PX


@dataclass(frozen=True, eq=False)
class WeighedCamera:
    """Matches of one camera, weighted by what they are worth.

    Attributes:
        block: without the correspondences of outlier frames.
        T_camera_lidar: (4, 4) where the frames are densest.
        outlier_frames: how many frames have no weight.
    """

    block: CameraBlock
    T_camera_lidar: Array
    outlier_frames: int


def weigh_all_frames(
    table: Correspondences,
    blocks: Mapping[str, CameraBlock],
    pairwise: Stage1,
    start: Mapping[str, Array],
) -> dict[str, WeighedCamera]:
    """Every camera's correspondences, weighted by what their residuals show.

    Args:
        table: with the confidences.
        blocks: per camera, its correspondences.
        pairwise: the frames' own poses.
        start: per camera, (4, 4) T_camera_lidar.
    """
    return {
        name: weigh_frames(
            block,
            table.of_camera(name).confidence.astype(np.float64),
            start[name],
            pairwise[name].solved if name in pairwise else {},
        )
        for name, block in blocks.items()
    }


def weigh_frames(
    matches: CameraBlock,
    confidence: Array,
    T_camera_lidar: Array,
    own: Mapping[int, Array],
) -> WeighedCamera:
    """Weigh the matches of one camera by what their residuals say of frames and confidences.

    Args:
        matches: of one camera.
        confidence: (n,) of its matches.
        T_camera_lidar: (4, 4) where to start; a wrong majority of frames does not matter then.
        own: (4, 4) poses of frames that are known, by PnP.
    """
    edges = matches.frame_edges
    if len(edges) - 1 < MIN_FRAMES:
        return WeighedCamera(matches, T_camera_lidar, 0)
    numbers = matches.frame[edges[:-1]]
    parts = [matches.select(np.arange(*edge)) for edge in pairwise(edges)]
    frames = _at_own_poses(parts, [own.get(int(n), T_camera_lidar) for n in numbers])
    sigmas = confidence_sigmas(frames.sizes, confidence)
    start = _densest_start(matches, frames, T_camera_lidar)
    T_consensus, weights = _consensus(frames, start)
    each = np.repeat(weights, np.diff(edges))
    counted = each > 0
    kept = matches.select(counted).weighted(each[counted] / sigmas[counted] ** 2)
    return WeighedCamera(kept, T_consensus, int(np.count_nonzero(weights == 0)))


@dataclass(frozen=True, eq=False)
class _Frames:
    """The frames of a camera, each at its own pose.

    Attributes:
        poses: (f,) T_lidar_camera.
        counts: (f,) matches.
        spreads: (f,) of whitened residuals, by those about the own pose.
        spreads_px: (f,) of unweighted ones.
        hessians: (f, 6, 6) of whitened residuals there.
        sizes: (n,) of the residuals there, relative to the frame's spread; in medians of a standard
            Gaussian.
    """

    poses: tuple[gtsam.Pose3, ...]
    counts: Array
    spreads: Array
    spreads_px: Array
    hessians: Array
    sizes: Array

    @property
    def noise(self) -> Array:
        """(f,) mean squares that noise moves whitened pixels of the own pose by."""
        return 6 * self.spreads**2 / self.counts


def _consensus(frames: _Frames, start: gtsam.Pose3) -> tuple[Array, Array]:
    """Where frames are densest, (4, 4) T_camera_lidar, and (f,) their weights, at most 1.

    Mean shift over the frames' own poses, with a kernel that is zero beyond a reach. Once it stands
    still the reach is widened, not to lose good frames. Frames with fewer matches than others may
    be farther off, by what noise moves their own poses.
    """
    pose = start
    for step in range(_STEPS):
        away, shift = _shifts(frames, pose)
        typical = np.median(frames.noise)
        apart = np.maximum(shift - _CHANCE * np.maximum(frames.noise - typical, 0), 0)
        if step <= _MOVING_STEPS:
            reach = _reach(apart, frames.noise, widened=step == _MOVING_STEPS)
        near = np.clip(_FLAT * (1 - np.sqrt(apart) / reach), 0, 1)
        if not near.any():  # no two frames agree: there is nothing to learn
            return to_T_camera_lidar(start), np.ones(len(near))
        scatter = max(float(near @ (shift - frames.noise) / near.sum()), 0.0)
        weights = near / (frames.spreads**2 + frames.counts * scatter / 6)
        pull = np.einsum("f,fij,fj->i", weights, frames.hessians, away)
        move = np.linalg.solve(_damped(np.einsum("f,fij->ij", weights, frames.hessians)), pull)
        pose = pose.retract(move)
        if step > _MOVING_STEPS and np.abs(move).max() < _SETTLED:
            break
    return to_T_camera_lidar(pose), weights / weights.max()


def _shifts(frames: _Frames, pose: gtsam.Pose3) -> tuple[Array, Array]:
    """(f, 6) from a pose to the frames' own; (f,) mean squares that whitened pixels move by."""
    away = np.array([pose.localCoordinates(other) for other in frames.poses])
    return away, np.einsum("fi,fij,fj->f", away, frames.hessians, away) / frames.counts


def _reach(shift: Array, noise: Array, *, widened: bool) -> float:
    """How far off frames may be to count, in units of how far off the nearest are.

    So frames that all err alike are all near. The wider reach goes by the spread of all that
    belong together, where that can be told; the nearest are then three at least, not to be misled
    by two that happen to agree, unless the third is far from them.
    """
    least = math.sqrt(float(np.median(noise)))
    two, three = (max(math.sqrt(_of_nearest(shift, fewest=n)), least) for n in (2, 3))
    if not widened:
        return _NARROW * two
    nearest = two if three > _ALONE * two else three
    return _REACH * max(min(robust_spread(np.sqrt(shift)), _WIDER * nearest), least)


def _densest_start(matches: CameraBlock, frames: _Frames, T_camera_lidar: Array) -> gtsam.Pose3:
    """The pose that explains most matches of all frames best: a frame's own, or the given one."""
    every = -(-len(frames.poses) // _CANDIDATES)
    candidates = [to_T_lidar_camera(T_camera_lidar), *frames.poses[::every]]
    scale_px = CAUCHY_SCALE_SIGMAS * float(np.median(frames.spreads_px))
    best = matches.best_candidate([to_T_camera_lidar(p) for p in candidates], scale_px)
    return candidates[best]


def _of_nearest(shift: Array, *, fewest: int) -> float:
    nearest = max(fewest, int(np.ceil(_NEAREST_SHARE * len(shift))))
    return float(np.sort(shift)[nearest - 1])


def _at_own_poses(parts: list[CameraBlock], starts: list[Array]) -> _Frames:
    """Fit every frame alone, robustly, by damped Gauss-Newton steps."""
    poses, spreads, spreads_px, hessians, sizes = [], [], [], [], []
    for part, start in zip(parts, starts, strict=True):
        pose = to_T_lidar_camera(start)
        for _ in range(_OWN_STEPS):
            own = _whitened_sizes(part, pose)
            spread = min(max(robust_spread(own[np.isfinite(own)]), part.least_spread), _MOST)
            sums = replace(part.block, scale=CAUCHY_SCALE_SIGMAS * spread).sums(pose)
            step = -np.linalg.solve(_damped(sums.hessian), sums.gradient)
            step *= min(1.0, _MAX_TURN_RAD / max(float(np.abs(step[:3]).max()), 1e-12))
            pose = pose.retract(step)
        poses.append(pose)
        spreads.append(spread)
        spreads_px.append(robust_spread(part.sizes(to_T_camera_lidar(pose))[0]))
        hessians.append(sums.hessian)
        sizes.append(own)
    counts = np.array([len(part.frame) for part in parts])
    corrected = _about_common_pose(np.array(spreads), counts)
    return _Frames(
        poses=tuple(poses),
        counts=counts.astype(np.float64),
        spreads=corrected,
        spreads_px=np.array(spreads_px),
        hessians=np.array(hessians),
        sizes=np.concatenate(sizes) / np.repeat(corrected, counts),
    )


def _about_common_pose(spreads: Array, counts: NDArray[np.int_]) -> Array:
    """(f,) spreads of residuals, by those about poses that were fitted to them.

    Six unknowns take their share of 2 n residuals; where they take most, the frame's matches are
    as good as other frames'.
    """
    grown = spreads * np.sqrt(2 * counts / np.maximum(2 * counts - 6, 1))
    told = counts >= _TOLD_BY
    typical = float(np.median(grown[told] if told.any() else grown))
    return np.asarray(np.where(told, grown, np.maximum(grown, typical)))


def _damped(hessian: Array) -> Array:
    """A Hessian that can be solved with, though it leaves directions free."""
    least = np.finfo(float).tiny
    return np.asarray(hessian + np.diag(_DAMPING * np.diag(hessian) + least))


def _whitened_sizes(part: CameraBlock, pose: gtsam.Pose3) -> Array:
    """(n,) sizes of whitened residuals, infinite where a point is not projectable."""
    T = to_T_camera_lidar(pose)
    sizes = np.full(len(part.frame), np.inf)
    sizes[part.errors_px(T)[1]] = part.sizes(T)[1]
    return sizes


def confidence_sigmas(sizes: Array, confidence: Array) -> Array:
    """How large errors are by their confidence: (n,) standard deviations, relative to the median.

    Monotone: errors do not grow with confidence. Where confidences say nothing they come out alike.

    Args:
        sizes: (n,) of whitened residuals, in medians of a standard Gaussian.
        confidence: (n,) the higher, the better.
    """
    known = np.flatnonzero(np.isfinite(sizes))
    order = known[np.argsort(confidence[known], kind="stable")]
    if len(order) < 2 * _BIN_MATCHES or confidence[order[0]] == confidence[order[-1]]:
        return np.ones(len(sizes))
    groups = np.array_split(order, min(_CONFIDENCE_BINS, len(order) // _BIN_MATCHES))
    spreads = np.array([max(robust_spread(sizes[group]), _LEAST_SIZE) for group in groups])
    counts = np.array([len(group) for group in groups])
    middles = np.array([np.median(confidence[group]) for group in groups])
    falling = isotonic_regression(np.log(spreads), weights=counts, increasing=False).x
    learnt = np.exp(np.interp(confidence, middles, falling))
    return np.asarray(learnt / np.median(learnt))
