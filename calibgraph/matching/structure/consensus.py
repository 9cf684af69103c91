"""The pose at which the shifts of all groups agree best."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from calibgraph.matching.structure.cross_entropy import maximize
from calibgraph.matching.structure.schedule import Level
from calibgraph.matching.structure.shift_scores import Scores

Array = NDArray[np.float64]

SAMPLES, STEPS = 400, 14  # of a search
PRIOR = 6.0  # penalty, in chance spreads of the score, of a twist sqrt(2 / 6) of the box from 0


def chance_spread(scores: Scores) -> float:
    """Standard deviation of the summed score over unrelated shifts."""
    return float(np.sqrt(scores.grids.var(axis=(1, 2), dtype=np.float64).sum()))


def find_consensus(scores: Scores, level: Level, *, seed: int) -> tuple[Array, float]:
    """Maximise the summed score over twists, less a weak prior on their size.

    Args:
        scores: the groups of one camera.
        level: half-widths of the search.
        seed: of the search's samples.

    Returns:
        (6,) twist (rotation [rad], translation [m]); its summed score in chance spreads.
    """
    box = np.repeat([level.rotation_rad, level.translation_m], 3)
    twist = search(scores, box, seed=seed, times=level.searches)
    contrast = float(summed_score(scores, twist[None])[0]) / (chance_spread(scores) + 1e-12)
    return twist, contrast


def search(scores: Scores, box: Array, *, seed: int, times: int = 3, prior: float = PRIOR) -> Array:
    """Maximise the summed score over as many unknowns as the flow has columns.

    Args:
        scores: the groups of one camera; its flow may have more columns than the six of a twist.
        box: (k,) half-width of the search, per column.
        seed: of the search's samples.
        times: how often to search; the best counts.
        prior: see ``PRIOR``.

    Returns:
        (k,) the best unknowns.
    """
    rng = np.random.default_rng(seed)
    found = [_search_once(scores, box, prior, rng) for _ in range(times)]
    return max(found, key=lambda pair: pair[1])[0]


def summed_score(scores: Scores, twists: Array) -> Array:
    """(n,) sum over groups of the score at the shift that each row of unknowns (n, k) implies."""
    out = np.zeros(len(twists))
    _sum_scores(scores.grids, scores.flow, np.ascontiguousarray(twists), out)
    return out


def _search_once(
    scores: Scores, box: Array, prior: float, rng: np.random.Generator
) -> tuple[Array, float]:
    """One cross-entropy search: the unknowns and their penalised score."""
    weight = 0.5 * prior * chance_spread(scores)

    def penalised(twists: Array) -> Array:
        return np.asarray(summed_score(scores, twists) - weight * ((twists / box) ** 2).sum(axis=1))

    return maximize(
        penalised,
        start=np.zeros(len(box)),
        spread=0.6 * box,
        limit=box,
        samples=SAMPLES,
        steps=STEPS,
        rng=rng,
    )


@njit(cache=True, fastmath=True, nogil=True)
def _sum_scores(grids, flow, twists, out):  # type: ignore[no-untyped-def]
    """Sum bilinearly interpolated scores; shifts outside the grid count 0."""
    reach = (grids.shape[1] - 1) // 2
    for i in range(twists.shape[0]):
        total = 0.0
        for g in range(grids.shape[0]):
            u = v = float(reach)
            for k in range(flow.shape[2]):
                u += flow[g, 0, k] * twists[i, k]
                v += flow[g, 1, k] * twists[i, k]
            if u < 0 or v < 0 or u >= 2 * reach or v >= 2 * reach:
                continue
            a, b = int(u), int(v)
            x, y = u - a, v - b
            total += (1 - y) * ((1 - x) * grids[g, b, a] + x * grids[g, b, a + 1])
            total += y * ((1 - x) * grids[g, b + 1, a] + x * grids[g, b + 1, a + 1])
        out[i] = total
