"""Pose consensus: the summed score of a pose over all groups, and what follows from it.

The pose at which the shifts of all groups agree best, by the cross-entropy method: samples that
concentrate on the best. Whether a pose stands out among displaced ones, over the same windows. And
the likelihood of poses by fine scores, against chance: among unrelated shifts the summed score
scatters by ``chance_sigma``; at the true pose it is z of these higher. For noise of that size the
logarithm of the likelihood is z times the score, in ``chance_sigma``. What windows of a frame and
frames of a place share makes the noise larger.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.matching.structure.schedule import LEVELS, Level
from calibgraph.matching.structure.shift_scores import ShiftScores
from factors.compiled import compiled

SAMPLES, STEPS = 400, 14  # of a search
MOST_SIGMAS = 3.0  # of its prior, by which a search displaces a further unknown
MOST_GROUPS = 0.9  # share of the groups
SAME_MAXIMUM = 1e-3  # relative difference of two searches' ends at the same maximum
PRIOR = 6.0
"""Penalty, in standard deviations of chance agreement, of a twist sqrt(2 / 6) of the box from 0."""
WEAK_PRIOR = 0.5  # the same of further unknowns, which have a prior of their own in the graph

ELITE_SHARE = 0.1  # of the samples, the best, shape the next step's distribution
WIDENING = 1.2  # of the elites' covariance, against premature convergence

DISPLACEMENTS_DEG, DISPLACEMENT_M = (1.2, 2.2), 0.4
"""About and along each axis: the displaced poses."""

FAR = replace(LEVELS[3], reach_rad=np.radians(2.0), weighed=False)
"""A fine level that reaches as far as rounds may end off. Coarse levels only propose poses: they
prefer some a degree off where fine ones are flat, as on grass slopes."""

CHANCE_VARIANCE = 3.0
"""Variance of the summed score over that of independent windows: what windows of a frame and frames
of a place share. With it the errors of a KITTI rig, of a car with six cameras and of a 16-beam
LiDAR are likeliest under the error bars that it leads to; without any one of them it is 3 or 4."""


def z_score(scores: ShiftScores, unknowns: Array) -> float:
    """Summed score at unknowns (k,), in standard deviations of chance agreement."""
    return float(sum_scores(scores, unknowns[None])[0]) / (scores.chance_sigma + 1e-12)


def find_consensus(scores: ShiftScores, level: Level, *, seed: int) -> tuple[Array, float]:
    """Maximise the summed score over twists and further unknowns, less a weak prior on their size.

    Returns:
        (6 + k,) twist (rotation [rad], translation [m]) and further unknowns; their z-score.
    """
    follows = _compensating(scores)
    fields = scores.jacobian[:, :, 6:] + scores.jacobian[:, :, :6] @ follows
    apart = replace(scores, jacobian=np.dstack([scores.jacobian[:, :, :6], fields]))
    half_widths = np.repeat([level.rotation_rad, level.translation_m], 3)
    half_widths = np.append(half_widths, _within_reach(apart))
    priors = np.repeat([PRIOR, WEAK_PRIOR], [6, len(half_widths) - 6])
    unknowns = maximize_score(apart, half_widths, seed=seed, searches=level.searches, prior=priors)
    unknowns[:6] += follows @ unknowns[6:]
    highest = float(sum_scores(scores, unknowns[None])[0])
    return unknowns, highest / (apart.chance_sigma + 1e-12)  # the same grids


def _compensating(scores: ShiftScores) -> Array:
    """(6, k) twists that make up for a unit of each further unknown, as far as a pose can."""
    columns = scores.jacobian.reshape(-1, scores.jacobian.shape[2])
    return np.asarray(-np.linalg.lstsq(columns[:, :6], columns[:, 6:], rcond=None)[0])


def _within_reach(scores: ShiftScores) -> Array:
    """(k,) half-widths of the further unknowns: what moves most groups within their grids."""
    reach = (scores.grids.shape[1] - 1) // 2
    steps = np.abs(scores.jacobian[:, :, 6:]).max(axis=1)
    most = np.quantile(steps, MOST_GROUPS, axis=0) if len(steps) else np.zeros(steps.shape[1])
    return np.asarray(np.minimum(MOST_SIGMAS, reach / np.maximum(most, 1e-9)))


def maximize_score(
    scores: ShiftScores,
    half_widths: Array,
    *,
    seed: int,
    searches: int = 3,
    prior: float | Array = PRIOR,
) -> Array:
    """Maximise the summed score over as many unknowns as the Jacobian has columns.

    Returns:
        (k,) the best unknowns.
    """
    rng = np.random.default_rng(seed)
    best, highest = np.zeros(len(half_widths)), -np.inf
    for _ in range(searches):
        unknowns, value = _maximize_once(scores, half_widths, prior, rng)
        found_again = abs(value - highest) < SAME_MAXIMUM * abs(highest)
        if value > highest:
            best, highest = unknowns, value
        if found_again:
            break
    return best


def sum_scores(scores: ShiftScores, unknowns: Array) -> Array:
    """(n,) sum over groups of the score at the shift that each row of unknowns (n, k) implies."""
    out = np.zeros(len(unknowns))
    columns = np.ascontiguousarray(unknowns.T, dtype=np.float32)
    count, size, _ = scores.grids.shape
    grids = scores.grids.reshape(count, size * size), size
    room = *np.empty((2, len(out)), np.float32), np.empty(len(out), np.uint32)
    _sum_interpolated(grids, scores.jacobian.astype(np.float32), columns, room, out)
    return out


def _maximize_once(
    scores: ShiftScores, half_widths: Array, prior: float | Array, rng: np.random.Generator
) -> tuple[Array, float]:
    """One cross-entropy search: the unknowns and their penalised score."""
    weight = np.full(len(half_widths), 0.5 * prior * scores.chance_sigma)

    def penalised(unknowns: Array) -> Array:
        return np.asarray(sum_scores(scores, unknowns) - (unknowns / half_widths) ** 2 @ weight)

    return maximize(
        penalised,
        start=np.zeros(len(half_widths)),
        sigmas=0.6 * half_widths,
        half_widths=half_widths,
        samples=SAMPLES,
        steps=STEPS,
        rng=rng,
    )


@compiled(fastmath=True)
def _sum_interpolated(grids, jacobian, unknowns, room, out):  # type: ignore[no-untyped-def]
    """Add bilinearly interpolated scores; shifts outside the grid count 0. unknowns: (k, n).

    A grid, a row of (g, size * size), is in the first-level cache for all of the unknowns.
    """
    (flat, size), (k, n), (us, vs, corner) = grids, unknowns.shape, room
    reach = (size - 1) // 2
    limit = np.float32(2 * reach)
    right, below = np.uint64(1), np.uint64(size)  # unsigned: numba tests others for negative ones
    for g in range(len(flat)):
        by, grid = jacobian[g], flat[g]
        for i in range(n):
            us[i] = vs[i] = reach
        for a in range(0, k - 2, 3):  # three at once: us and vs are loaded a third as often
            b, c = a + 1, a + 2
            for i in range(n):
                x, y, z = unknowns[a, i], unknowns[b, i], unknowns[c, i]
                us[i] += by[0, a] * x + by[0, b] * y + by[0, c] * z
                vs[i] += by[1, a] * x + by[1, b] * y + by[1, c] * z
        for a in range(k - k % 3, k):
            for i in range(n):
                us[i] += by[0, a] * unknowns[a, i]
                vs[i] += by[1, a] * unknowns[a, i]
        for i in range(n):
            inside = (us[i] >= 0) & (vs[i] >= 0) & (us[i] < limit) & (vs[i] < limit)
            u, v = us[i] if inside else np.float32(0), vs[i] if inside else np.float32(0)
            column, row = np.int32(u), np.int32(v)
            corner[i] = row * size + column
            us[i] = u - np.float32(column)
            vs[i] = v - np.float32(row) if inside else np.float32(-1)
        for i in range(n):
            at, x, y = np.uint64(corner[i]), us[i], vs[i]
            under = at + below
            first = grid[at] + x * (grid[at + right] - grid[at])
            second = grid[under] + x * (grid[under + right] - grid[under])
            out[i] += first + y * (second - first) if y >= 0 else np.float32(0)


def maximize(
    objective: Callable[[Array], Array],
    *,
    start: Array,
    sigmas: Array,
    half_widths: Array,
    samples: int,
    steps: int,
    rng: np.random.Generator,
) -> tuple[Array, float]:
    """Maximise within a box about a start.

    Args:
        objective: (n,) values of (n, k) points.
        start: (k,) mean of the first samples, and centre of the box.
        sigmas: (k,) standard deviations of the first samples.
        half_widths: (k,) of the box.
        samples: per step; four times that in the first.
        steps: number of steps.
        rng: source of the samples.

    Returns:
        The last mean (k,), and its value.
    """
    mean, root = start, np.diag(sigmas)
    elites, least = max(len(start) + 2, round(ELITE_SHARE * samples)), (1e-4 * half_widths) ** 2
    for step in range(steps):
        count = samples * (4 if step == 0 else 1)
        points = mean + rng.standard_normal((count, len(start))) @ root.T
        points = np.clip(points, start - half_widths, start + half_widths)
        elite = points[np.argsort(-objective(points))[:elites]]
        mean = elite.mean(axis=0)
        centred = elite - mean
        covariance = WIDENING * (centred.T @ centred * (1 / (elites - 1))) + np.diag(least)
        root = np.linalg.cholesky(covariance)
    return mean, float(objective(mean[None])[0])


def score_displaced(scores: ShiftScores) -> tuple[NDArray[np.int64], Array]:
    """Frames (f,), and their scores (f, n) at a pose, then at displaced poses."""
    frames, twists = np.unique(scores.frame), _displacements()
    per_frame = [sum_scores(_of_frame(scores, frame), twists) for frame in frames]
    return frames, np.array(per_frame).reshape(len(frames), len(twists))


def displaced_z_score(per_frame: Array) -> float:
    """The summed score at the pose less the mean of the displaced, in deviations of the latter."""
    own, *displaced = per_frame.sum(axis=0)
    return float((own - np.mean(displaced)) / (np.std(displaced) + 1e-12))


def _of_frame(scores: ShiftScores, frame: int) -> ShiftScores:
    rows = scores.frame == frame
    return replace(scores, grids=scores.grids[rows], jacobian=scores.jacobian[rows])


def _displacements() -> Array:
    """(n, 6) twists: none, then rotations about and shifts along each axis, both ways."""
    angles = [np.radians(angle) * sign for angle in DISPLACEMENTS_DEG for sign in (-1, 1)]
    shifts = [DISPLACEMENT_M * sign for sign in (-1, 1)]
    axes = np.eye(6)
    twists = [axes[axis] * size for axis in range(3) for size in angles]
    twists += [axes[axis] * size for axis in range(3, 6) for size in shifts]
    return np.array([np.zeros(6), *twists])


def log_likelihood(scores: ShiftScores) -> Callable[[Array], Array]:
    """The (n,) logarithms of the likelihood of twists (n, 6) from the pose of the scores.

    Args:
        scores: of one camera, at ``FAR``, about the pose in question.
    """
    amplitude = max(z_score(scores, np.zeros(6)), 0.0)
    factor = amplitude / (CHANCE_VARIANCE * (scores.chance_sigma + 1e-12))
    return lambda twists: factor * sum_scores(scores, twists)
