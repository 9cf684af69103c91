"""Pose consensus: the pose at which the shifts of all groups agree best."""

from dataclasses import replace

import numpy as np

from calibgraph.arrays import Array
from calibgraph.matching.structure.cross_entropy import maximize
from calibgraph.matching.structure.schedule import Level
from calibgraph.matching.structure.shift_scores import ShiftScores
from factors.compiled import compiled

SAMPLES, STEPS = 400, 14  # of a search
MOST_SIGMAS = 3.0  # of its prior, by which a search displaces a further unknown
MOST_GROUPS = 0.9  # share of the groups
SAME_MAXIMUM = 1e-3  # relative difference of two searches' ends at the same maximum
PRIOR = 6.0
"""Penalty, in standard deviations of chance agreement, of a twist sqrt(2 / 6) of the box from 0."""
WEAK_PRIOR = 0.5  # the same of further unknowns, which have a prior of their own in the graph


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
    return unknowns, z_score(scores, unknowns)


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
    _sum_interpolated(grids, scores.jacobian.astype(np.float32), columns, out)
    return out


def _maximize_once(
    scores: ShiftScores, half_widths: Array, prior: float | Array, rng: np.random.Generator
) -> tuple[Array, float]:
    """One cross-entropy search: the unknowns and their penalised score."""
    weight = 0.5 * prior * scores.chance_sigma

    def penalised(unknowns: Array) -> Array:
        penalty = (weight * (unknowns / half_widths) ** 2).sum(axis=1)
        return np.asarray(sum_scores(scores, unknowns) - penalty)

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
def _sum_interpolated(grids, jacobian, unknowns, out):  # type: ignore[no-untyped-def]
    """Add bilinearly interpolated scores; shifts outside the grid count 0. unknowns: (k, n).

    A grid, a row of (g, size * size), is in the first-level cache for all of the unknowns.
    """
    (flat, size), (k, n) = grids, unknowns.shape
    reach = (size - 1) // 2
    limit = np.float32(2 * reach)
    right, below = np.uint64(1), np.uint64(size)  # unsigned: numba tests others for negative ones
    us, vs, corner = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.uint32)
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
