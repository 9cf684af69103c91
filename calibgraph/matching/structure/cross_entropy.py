"""The cross-entropy method: maximise a function by samples that concentrate on the best."""

from collections.abc import Callable

import numpy as np

from calibgraph.arrays import Array

ELITE_SHARE = 0.1  # of the samples, the best, shape the next step's distribution
WIDENING = 1.2  # of the elites' covariance, against premature convergence


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
    elites = max(len(start) + 2, round(ELITE_SHARE * samples))
    for step in range(steps):
        count = samples * (4 if step == 0 else 1)
        points = mean + rng.standard_normal((count, len(start))) @ root.T
        points = np.clip(points, start - half_widths, start + half_widths)
        elite = points[np.argsort(-objective(points))[:elites]]
        mean = elite.mean(axis=0)
        covariance = WIDENING * np.cov(elite.T) + np.diag((1e-4 * half_widths) ** 2)
        root = np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
    return mean, float(objective(mean[None])[0])
