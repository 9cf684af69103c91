"""Acceptance: could the z-score of a pose have come about by chance?

The best z-score of a search where there is nothing to find follows a Gumbel distribution: it is the
highest of many. Its location differs from scene to scene, most of all with the LiDAR. It is not
measured on the scene itself: searches in clouds turned about the vertical, of which it is known,
had 3 to 7 where cameras that look at façades had up to 15 in the clouds of other streets.
"""

from __future__ import annotations

import math

FALSE_ACCEPTANCE = 1e-3
"""Share of cameras with nothing to find of which a pose may be accepted."""

PRIOR_LOCATION, PRIOR_SIGMA, SCALE = 5.7, 2.1, 0.92
"""Of the best z-score of a search for one roll: mean and standard deviation over scenes of the
location, and scale. In turned clouds of five KITTI sequences, `dgp_scene01` and `vlp16_distorted`,
12 cameras, two guesses and three turns each. Locations: KITTI 3.8 to 5.3, 40,000 points a scan 6.5
to 8.5, 16 beams 11."""


def least_z_score(tries: float) -> float:
    """From which z-score on a pose is accepted.

    The tail of the Gumbel distribution is exponential, so that what is uncertain of its location
    raises it by half the variance over the scale.

    Args:
        tries: how much was searched, in searches for one roll; a single pose is less than one.
    """
    location = PRIOR_LOCATION + 0.5 * PRIOR_SIGMA**2 / SCALE
    return location + SCALE * math.log(tries / FALSE_ACCEPTANCE)
