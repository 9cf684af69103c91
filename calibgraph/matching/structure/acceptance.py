"""Acceptance: could the z-score of a pose have come about by chance?

The best z-score of a search where there is nothing to find follows a Gumbel distribution: it is the
highest of many. Its location differs from scene to scene, with the LiDAR, and most of all with how
much a place is like another one. It is not measured on the scene itself: searches in clouds turned
about the vertical had 3 to 7 where cameras that look at façades had up to 15
in the clouds of other streets.
"""

import math
from collections.abc import Iterable

FALSE_ACCEPTANCE = 1e-3
"""Accepted share of wrong poses, among cameras whose true pose is out of reach."""

PRIOR_LOCATION, PRIOR_SIGMA, SCALE = 5.7, 3.0, 0.92
"""Of the best z-score of a search for one roll: mean and standard deviation over scenes of the
location, and scale. Locations in turned clouds and in clouds of other places: KITTI 4 to 5, 26,000
to 47,000 points a scan 5 to 7, 16 beams in a laboratory 11; rendered streets, all alike, 12."""


_LOCATION = PRIOR_LOCATION + 0.5 * PRIOR_SIGMA**2 / SCALE
"""The tail of the Gumbel distribution is exponential, so the uncertainty of its location
raises it by half the variance over the scale."""


def least_z_score(tries: float) -> float:
    """The smallest z-score of an accepted pose."""
    return _LOCATION + SCALE * math.log(tries / FALSE_ACCEPTANCE)


def are_accepted(z_scores: Iterable[float], tries: float) -> bool:
    """Whether poses of several cameras, one of each, are accepted together."""
    excess = sum(max(0.0, z_score - _LOCATION) for z_score in z_scores)
    return excess >= SCALE * math.log(tries / FALSE_ACCEPTANCE)
