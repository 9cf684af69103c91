"""Weights of frames and of confidences, from the residuals. Not in the paper; off in its presets.

The matches of one frame share errors: a learned matcher that stops short displaces all of them, and
thousands of matches then agree on a wrong extrinsic. So frames are random effects: each has an
extrinsic of its own, which scatters about the camera's. The weight of a frame follows from the
spread of its matches about its own extrinsic and from that scatter, whatever the number of its
matches; a frame far from where frames are densest has weight zero. Confidences become standard
deviations by the residuals of the matches that have them.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from calibgraph.arrays import Array
from calibgraph.model.config import Config, Terms
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.geometry import invert, local_coordinates, retract_all
from calibgraph.parallel import map_on_cores
from calibgraph.solver.matches import CameraBlock
from calibgraph.solver.pnp import DAMPING
from calibgraph.solver.robust import (
    CAUCHY_SCALE_SIGMAS,
    CUT,
    MIN_SIGMA_PX,
    robust_spread,
    robust_spreads,
)
from calibgraph.solver.stage1 import Stage1
from calibgraph.solver.two_pass import USING_CORRESPONDENCES
from factors import to_runs

MIN_FRAMES_TO_WEIGH = 8
"""Fewer frames do not determine their own scatter; weights from them would shrink the error bar."""


# Chosen on simulated drives of the paper's two rigs, other ones than those that are reported.
_NEAREST_SHARE = 0.15  # of the frames: the distance of the last of them is the unit of nearness
_SEARCH_REACH = 3.0  # units of nearness, while the mean shift moves to where frames are densest
_REACH = 4.0  # units from there on, at which the weight of a frame becomes zero
_FAR_THIRD = 4.0  # times farther than the two nearest: a third frame does not belong to the two
_FLAT = 2.0  # a frame has its full weight up to half the reach
_MAX_WIDENING = 2.2  # spread over nearness: median of a Rayleigh distribution, by that quantile
_SEARCH_STEPS, _STEPS = 5, 15  # of the mean shift: with the narrow reach, and in all
_MAX_CANDIDATES = 200  # frames of which the own extrinsic is tried as a start
_CONVERGED = 1e-6  # rad, m: far below any standard deviation
_CONFIDENCE_BINS, _BIN_MATCHES = 20, 100  # a spread of 100 matches is known to 7 %
_CHANCE = 2.0  # times the mean square displacement by noise: exceeded by 5 % of frames
_MIN_SIZE = 0.05  # of a frame's spread, which is at least MIN_SIGMA_PX
_OWN_FITS, _OWN_TOLERANCE = 3, 1e-4  # of a frame's own extrinsic; relative, of the cost
_SETTLED = 0.05  # relative change of the spreads of all frames
_MAX_SPREAD = 1e6  # px, in place of the infinite spread of a frame that is all behind its camera
_MIN_MATCHES = 10  # fewer residuals about a frame's own extrinsic (6 unknowns) give no spread


@dataclass(frozen=True, eq=False)
class FrameFits:
    """The frames of a camera, each at its own extrinsic.

    Attributes:
        T_camera_lidar: (f, 4, 4) each frame's own.
        counts: (f,) matches.
        spreads: (f,) of whitened residuals about the common extrinsic, from those about their own.
        spreads_px: (f,) of unweighted ones, about their own.
        hessians: (f, 6, 6) of whitened residuals there, in the tangent of T_lidar_camera.
        sizes: (n,) of the residuals there, over the frame's spread, as ``CameraBlock.all_sizes``;
            infinite where a point is not projectable.
    """

    T_camera_lidar: Array
    counts: Array
    spreads: Array
    spreads_px: Array
    hessians: Array
    sizes: Array

    @property
    def noise(self) -> Array:
        """(f,) mean square displacement of whitened pixels by the noise of the own extrinsic."""
        return 6 * self.spreads**2 / self.counts


def fit_each_frame(block: CameraBlock, own: Array, common: Array, *, most_px: float) -> FrameFits:
    """Fit every frame alone, its loss as wide as its residuals spread.

    Args:
        block: of one camera.
        own: (f, 4, 4) T_camera_lidar of its frames, by PnP of each.
        common: (4, 4) T_camera_lidar that a frame starts from if its own fits worse.
        most_px: spread of a frame's residuals, beyond which none of its matches are good, so that a
            fit would lead anywhere: it stays where it starts.
    """
    runs, counts = to_runs(block.frame_edges), block.frame_counts
    least = block.least_spreads(runs)

    def bounded(spreads: Array) -> Array:
        return np.minimum(np.maximum(spreads, least), _MAX_SPREAD)

    tried = np.stack([own, np.broadcast_to(common, own.shape)])
    found = [robust_spreads(block.all_sizes(T, runs)[1], runs) for T in tried]
    better = (found[0] <= found[1])[:, None, None]
    T: Array = np.where(better, tried[0], tried[1])
    spreads = bounded(np.minimum(found[0], found[1]))
    is_fitted = spreads * MIN_SIGMA_PX < most_px * least
    for _ in range(_OWN_FITS):
        scales, before = CAUCHY_SCALE_SIGMAS * spreads, spreads
        moved, sums, _ = block.block.fit(T, runs, scales, tolerance=_OWN_TOLERANCE)
        T = np.where(is_fitted[:, None, None], moved, T)
        sizes_px, sizes = block.all_sizes(T, runs)
        spreads = bounded(robust_spreads(sizes, runs))
        if np.abs(spreads / before - 1.0).max() < _SETTLED:
            break
    hessians = sums.hessian
    spreads_px = spreads if sizes_px is sizes else robust_spreads(sizes_px, runs)
    each = np.repeat(spreads, counts)
    inside = np.add.reduceat(sizes <= CUT * each, runs[:, 0])
    spreads = _about_common_extrinsic(spreads, counts.astype(np.float64), inside)
    return FrameFits(T, counts.astype(np.float64), spreads, spreads_px, hessians, sizes / each)


def _about_common_extrinsic(spreads: Array, counts: Array, inside: Array) -> Array:
    """(f,) spreads of residuals about the common extrinsic, from those about each frame's own.

    Six unknowns take their share of 2 n residuals; where they take most of the ``inside``, from
    which a spread is measured, it is at least that of a typical frame: among outliers there is
    always a pose that fits a few matches exactly.
    """
    grown = spreads * np.sqrt(2 * counts / np.maximum(2 * counts - 6, 1))
    enough = inside >= _MIN_MATCHES
    typical = float(np.median(grown[enough] if enough.any() else grown))
    return np.asarray(np.where(enough, grown, np.maximum(grown, typical)))


def weigh_all_frames(
    table: Correspondences,
    blocks: Mapping[str, CameraBlock],
    stage1: Stage1,
    start: Mapping[str, Array],
    *,
    config: Config,
    terms: Terms,
) -> tuple[dict[str, CameraBlock], dict[str, Array], dict[str, int]]:
    """Per camera, the three of :func:`weigh_frames`.

    Unchanged if ``learnt_weights`` is off, Stage 1 is not PnP, or ``terms`` has no reprojection
    term.

    Args:
        table: with the confidences.
        blocks: per camera, its correspondences.
        stage1: with T_camera_lidar of single frames.
        start: per camera, (4, 4) T_camera_lidar.
        config: ``learnt_weights``, ``stage1``.
        terms: of the objective.
    """
    is_wanted = config.learnt_weights and config.stage1 == "pnp" and terms in USING_CORRESPONDENCES
    if not (blocks and is_wanted):
        return dict(blocks), {}, {}

    def weigh(name: str) -> tuple[CameraBlock, Array, int]:
        return weigh_frames(
            blocks[name],
            table.of_camera(name).confidence.astype(np.float64),
            start[name],
            stage1[name].by_frame if name in stage1 else {},
            most_px=config.pnp_threshold_px,
        )

    weighed = zip(*map_on_cores(weigh, [*blocks]), strict=True)
    kept, densest, outliers = (dict(zip(blocks, each, strict=True)) for each in weighed)
    return kept, densest, outliers


def weigh_frames(
    block: CameraBlock,
    confidence: Array,
    T_camera_lidar: Array,
    by_frame: Mapping[int, Array],
    *,
    most_px: float,
) -> tuple[CameraBlock, Array, int]:
    """Weigh the correspondences of one camera by the residuals of its frames and confidences.

    Args:
        block: of one camera.
        confidence: (n,) of its correspondences.
        T_camera_lidar: (4, 4) where to start; it may be that of a wrong majority of frames.
        by_frame: (4, 4) T_camera_lidar of single frames, by PnP.
        most_px: as of :func:`fit_each_frame`.

    Returns:
        The correspondences without those of outlier frames; (4, 4) T_camera_lidar where the frames
        are densest; the number of outlier frames.
    """
    edges = block.frame_edges
    if len(edges) - 1 < MIN_FRAMES_TO_WEIGH:
        return block, T_camera_lidar, 0
    numbers = block.frame[edges[:-1]]
    own = np.array([by_frame.get(number, T_camera_lidar) for number in numbers.tolist()])
    frames = fit_each_frame(block, own, T_camera_lidar, most_px=most_px)
    sigmas = confidence_sigmas(frames.sizes, confidence)
    start = densest_start(block, frames, T_camera_lidar)
    T_consensus, weights = find_consensus(frames, start)
    each = np.repeat(weights, np.diff(edges))
    counted = each > 0
    kept = block.select(counted).with_weights(each[counted] / sigmas[counted] ** 2)
    return kept, T_consensus, int(np.count_nonzero(weights == 0))


def find_consensus(frames: FrameFits, start: Array) -> tuple[Array, Array]:
    """Where frames are densest, (4, 4) T_camera_lidar, and (f,) their weights, at most 1.

    Mean shift over the frames' own extrinsics, with a kernel that is zero beyond a reach. After the
    first steps the reach is widened, to keep every good frame. A frame with fewer matches than
    others may be farther off, by the noise of its own extrinsic.
    """
    center, noise = start, frames.noise
    typical = float(np.median(noise))
    T_lidar_camera, hessians = invert(frames.T_camera_lidar), frames.hessians.reshape(-1, 36)
    by_chance, own = _CHANCE * np.maximum(noise - typical, 0), frames.spreads**2
    for number in range(_STEPS):
        away = local_coordinates(center, T_lidar_camera)
        products = (frames.hessians @ away[:, :, None])[:, :, 0]
        shift = (away * products).sum(axis=1) / frames.counts  # mean squares of whitened pixels
        apart = np.maximum(shift - by_chance, 0)
        if number <= _SEARCH_STEPS:
            reach = _reach(apart, math.sqrt(typical), widened=number == _SEARCH_STEPS)
        near = np.minimum(np.maximum(_FLAT * (1 - np.sqrt(apart) / reach), 0), 1)
        if not near.any():  # no two frames agree
            return start, np.ones(len(near))
        scatter = max(float(near @ (shift - noise) / near.sum()), 0.0)
        weights = near / (own + frames.counts * scatter / 6)
        hessian = (weights @ hessians).reshape(6, 6)
        hessian.flat[::7] *= 1 + DAMPING
        step = np.linalg.solve(hessian, weights @ products)
        center = retract_all(center[None], step[None])[0]
        if number > _SEARCH_STEPS and np.abs(step).max() < _CONVERGED:
            break
    return center, weights / weights.max()


def _reach(shift: Array, least: float, *, widened: bool) -> float:
    """The displacement at which the weight becomes zero, in multiples of that of the nearest.

    So frames with equally large errors are all near. The wider reach follows the spread of all
    inliers, where there is one; the nearest are then at least three, since two may agree by chance,
    unless the third is far from them.

    Args:
        shift: (f,) mean square displacements of whitened pixels.
        least: displacement by the noise of a typical frame.
        widened: whether the wider reach is wanted.
    """
    nearest_first, share = np.sort(shift), math.ceil(_NEAREST_SHARE * len(shift))
    two, three = (max(math.sqrt(nearest_first[max(n, share) - 1]), least) for n in (2, 3))
    if not widened:
        return _SEARCH_REACH * two
    nearest = two if three > _FAR_THIRD * two else three
    return _REACH * max(min(robust_spread(np.sqrt(shift)), _MAX_WIDENING * nearest), least)


def densest_start(block: CameraBlock, frames: FrameFits, T_camera_lidar: Array) -> Array:
    """The (4, 4) T_camera_lidar of least loss over all frames: a frame's own, or the given one."""
    step = -(-len(frames.T_camera_lidar) // _MAX_CANDIDATES)
    candidates: list[Array] = [T_camera_lidar, *frames.T_camera_lidar[::step]]
    scale_px = CAUCHY_SCALE_SIGMAS * float(np.median(frames.spreads_px))
    return candidates[block.best_candidate(candidates, scale_px)]


def confidence_sigmas(sizes: Array, confidence: Array) -> Array:
    """(n,) standard deviations of errors as a function of the confidence, over their median.

    Monotone: they do not grow with the confidence. An uninformative confidence gives equal ones.

    Args:
        sizes: (n,) of whitened residuals, over the median of a standard Gaussian's.
        confidence: (n,) of the same matches.
    """
    known = np.flatnonzero(np.isfinite(sizes))
    order = known[_rising(confidence[known])]
    parts = min(_CONFIDENCE_BINS, len(order) // _BIN_MATCHES)  # of as many matches
    if parts < 2 or confidence[order[0]] == confidence[order[-1]]:  # noqa: PLR2004
        return np.ones(len(sizes))
    groups = to_runs(np.linspace(0, len(order), parts + 1).astype(np.int64))
    spreads = np.maximum(robust_spreads(sizes[order], groups), _MIN_SIZE)
    counts, ordered = groups[:, 1] - groups[:, 0], confidence[order]
    middles = (ordered[(groups.sum(axis=1) - 1) // 2] + ordered[groups.sum(axis=1) // 2]) / 2
    falling: Array = isotonic_regression(np.log(spreads), weights=counts, increasing=False).x
    in_order = np.exp(np.interp(ordered, middles, falling))  # in order, places are found faster
    if len(order) == len(sizes):  # they fall
        learnt = in_order / ((in_order[(len(order) - 1) // 2] + in_order[len(order) // 2]) / 2)
        found = np.empty(len(sizes))
        found[order] = learnt
        return found
    learnt = np.exp(np.interp(confidence, middles, falling))
    return np.asarray(learnt / np.median(learnt))


def _rising(confidence: Array) -> NDArray[np.int64]:
    """(n,) the order of positive numbers, which are single-precision; equal ones keep theirs.

    Each is one integer with its place, since the bits of positive floats have the floats' order:
    numpy sorts these several times faster than it finds a stable order.
    """
    bits = confidence.astype(np.float32).view(np.uint32).astype(np.uint64)
    keys = np.sort(bits << np.uint64(32) | np.arange(len(bits), dtype=np.uint64))
    return (keys & np.uint64(0xFFFFFFFF)).astype(np.int64)
