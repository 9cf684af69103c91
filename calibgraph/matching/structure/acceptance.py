"""Acceptance: could the z-score of a pose have come about by chance?

The best z-score of a search where there is nothing to find follows a Gumbel distribution: it is the
highest of many. Its location differs from scene to scene, most of all with the LiDAR; on a scene,
it is measured by searches of the same images in clouds that are turned about the vertical.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

FALSE_ACCEPTANCE = 1e-3
"""Share of cameras with nothing to find of which a pose may be accepted."""

PRIOR_LOCATION, PRIOR_SIGMA, SCALE = 5.7, 2.1, 0.92
"""Mean and standard deviation over scenes of the location, and scale, of the best z-score of a
search for one roll: 12 cameras of five KITTI sequences, `dgp_scene01` and `vlp16_distorted`, two
guesses and three turns each. Locations: KITTI 3.8 to 5.3, 40,000 points a scan 6.5 to 8.5, 16 beams
11."""

_VARIANCE = (SCALE * math.pi) ** 2 / 6
_EULER = 0.5772156649


@dataclass(frozen=True)
class Chance:
    """The distribution of the best z-score of a search with nothing to find, on a scene.

    Attributes:
        seen: best z-scores of such searches, for one roll each, on this scene.
    """

    seen: tuple[float, ...] = ()

    def with_seen(self, z_score: float) -> Chance:
        """After one more search with nothing to find."""
        return replace(self, seen=(*self.seen, z_score))

    def least_z_score(self, tries: float) -> float:
        """From which z-score on a pose is accepted.

        The tail of the Gumbel distribution is exponential, so that what is uncertain of its
        location raises it by half the variance over the scale.

        Args:
            tries: how much was searched, in searches for one roll; a single pose is less than one.
        """
        weight = 1 / PRIOR_SIGMA**2 + len(self.seen) / _VARIANCE
        own = sum(z_score - SCALE * _EULER for z_score in self.seen)
        location = (PRIOR_LOCATION / PRIOR_SIGMA**2 + own / _VARIANCE) / weight
        return location + 0.5 / weight / SCALE + SCALE * math.log(tries / FALSE_ACCEPTANCE)


def may_be_accepted(z_score: float, tries: float) -> bool:
    """Whether a z-score is accepted on scenes, not too rare, where chance brings about little."""
    lucky = Chance((PRIOR_LOCATION - PRIOR_SIGMA,) * 10)
    return z_score >= lucky.least_z_score(tries)
