"""Acceptance: could the z-score of a pose have come about by chance?

The best z-score of a search where there is nothing to find follows a Gumbel distribution: it is the
highest of many. Its location differs from scene to scene, with the LiDAR, and most of all with how
much a place is like another one. It is not measured on the scene itself: searches in clouds turned
about the vertical had 3 to 7 where cameras that look at façades had up to 15
in the clouds of other streets. With one to three frames that prior asks for more than right poses
have. So there a pose has a second look at the fine levels, over which no search has maximized, and
the location is measured in mirrored images, where streets that are alike are alike, too.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

FALSE_ACCEPTANCE = 1e-3
"""Accepted share of wrong poses, among cameras whose true pose is out of reach."""
FEW_FRAMES = 3
"""Up to so many frames of a camera, the location is measured in mirrored images."""


@dataclass(frozen=True)
class Chance:
    """The best agreement by chance of a search for one roll.

    Attributes:
        location, sigma: mean and standard deviation over scenes of the location.
        scale: of the Gumbel distribution.
    """

    location: float
    sigma: float
    scale: float

    @property
    def raised(self) -> float:
        """The location with its uncertainty.

        The tail of the distribution is exponential, so that this raises it by half the variance
        over the scale.
        """
        return self.location + 0.5 * self.sigma**2 / self.scale


SEARCH = Chance(6.6, 3.0, 0.92)
"""Of the z-score. Locations in turned clouds and in clouds of other places, where two candidates of
a roll were refined: KITTI 4 to 5, 26,000 to 47,000 points a scan 5 to 7, 16 beams in a laboratory
11; rendered streets, all alike, 12. Where all of them are, it is higher by 0.9 (KITTI, 30 pairs of
recordings)."""


MIRRORED_RATIO, MIRRORED_SPREAD, SECOND_LOOK_SCALE = 1.1, 0.2, 1.1
"""Of the z-score of a search in one to three frames plus that of its best pose at the fine levels:
mean and standard deviation over scenes of the location over the same sum in mirrored images, and
scale. In clouds of other places the sum was 0.9 to 1.2 times that in mirrored images on KITTI and
in most rendered scenes, up to 1.6 times in tunnels and in streets that are all alike."""


def second_look_chance(mirrored: float) -> Chance:
    """Of the sum of both z-scores, from what a search for one roll finds in mirrored images."""
    return Chance(MIRRORED_RATIO * mirrored, MIRRORED_SPREAD * mirrored, SECOND_LOOK_SCALE)


def least_z_score(tries: float, chance: Chance = SEARCH) -> float:
    """The smallest z-score, or sum of two, of an accepted pose."""
    return chance.raised + chance.scale * math.log(tries / FALSE_ACCEPTANCE)


def probability_by_chance(z_score: float, tries: float, chance: Chance = SEARCH) -> float:
    """The probability that a search with nothing to find ends at this z-score or a higher one."""
    return min(1.0, tries * math.exp((chance.raised - z_score) / chance.scale))


def are_accepted(z_scores: Iterable[float], tries: float) -> bool:
    """Whether poses of several cameras, one of each, are accepted together."""
    excess = sum(max(0.0, z_score - SEARCH.raised) for z_score in z_scores)
    return excess >= SEARCH.scale * math.log(tries / FALSE_ACCEPTANCE)
