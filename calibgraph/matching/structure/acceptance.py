"""Acceptance: could the z-score of a pose have come about by chance?

The best z-score of a search where there is nothing to find follows, from scene to scene, a Gumbel
distribution: it is the highest of many. What it is on the scene itself is measured by searches that
cannot find anything, of the same images in clouds turned about the vertical.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

FALSE_ACCEPTANCE = 1e-3
"""Share of searches with nothing to find of which a pose may be accepted."""

PRIOR_MEAN, PRIOR_SIGMA = 6.0, 1.8
"""Of the most likely best z-score, over scenes."""
SCALE = 0.9
"""Of the Gumbel distribution of the best z-score, on one scene."""

TRIES = 24.0
"""Independent poses that a search tries, about: the best z-score of a single pose is lower."""

_GUMBEL_SIGMA = math.pi / math.sqrt(6)
_EULER = 0.5772156649


@dataclass(frozen=True)
class Chance:
    """The distribution of the best z-score of a search with nothing to find, on a scene.

    Attributes:
        seen: best z-scores of such searches on this scene.
    """

    seen: tuple[float, ...] = ()

    def with_seen(self, z_score: float) -> Chance:
        """After one more search with nothing to find."""
        return replace(self, seen=(*self.seen, z_score))

    def least_z_score(self, *, alone: bool = False) -> float:
        """From which z-score on a pose is accepted.

        Args:
            alone: a single pose was tried, not the many of a search.
        """
        location, scale = self._predictive()
        tries = 1 / TRIES if alone else 1.0
        return location + scale * (math.log(tries) - math.log(-math.log1p(-FALSE_ACCEPTANCE)))

    def may_be_accepted(self, z_score: float) -> bool:
        """Whether there are scenes, not too rare, on which a search's z-score is accepted."""
        lucky = Chance((PRIOR_MEAN - PRIOR_SIGMA,) * 10)
        return z_score >= lucky.least_z_score()

    def _predictive(self) -> tuple[float, float]:
        """Location and scale: the prior, moved by what has been seen on the scene.

        The variance of what is not known of the location widens the scale.
        """
        variance = (SCALE * _GUMBEL_SIGMA) ** 2
        weight = 1 / PRIOR_SIGMA**2 + len(self.seen) / variance
        own = sum(z_score - SCALE * _EULER for z_score in self.seen)
        location = (PRIOR_MEAN / PRIOR_SIGMA**2 + own / variance) / weight
        return location, math.sqrt(SCALE**2 + 1 / weight / _GUMBEL_SIGMA**2)
