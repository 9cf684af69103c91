"""Keys of the variables: ``Pose3`` in the LiDAR frame; scan distortion and lenses are vectors.

x_c   the mount of camera c: ``T_lidar_camera`` of the two sensors as bodies
d     the scan distortion, in standard deviations of its prior
y_c   its alignment: where the points, as the LiDAR delivers them, meet its image; printed alone
m_c   camera c as its matches show it at every place
n_c   camera c as its pairs with other cameras show it
o     the cloud as it is displaced at every place
o_p   the cloud as it is displaced at place p
a_cp  camera c as its matches at place p show it
l_c   the lens of camera c, if it is estimated, in standard deviations of its prior
s_c   that lens as its matches show it
"""

from collections.abc import Callable
from functools import cache

import gtsam

CLOUD = int(gtsam.symbol("o", 0))
DISTORTION = int(gtsam.symbol("d", 0))

MOST_CAMERAS = 1000
"""``a3002`` is camera 2 at place 3."""


Key = Callable[[int], int]


def _keys_of(letter: str) -> Key:
    """From the number of a camera or place to the key of its variable."""
    return cache(lambda number: int(gtsam.symbol(letter, number)))


camera_key, aligned_key, matched_key, paired_key = map(_keys_of, "xymn")
lens_key, seen_lens_key, cloud_at_key = map(_keys_of, "lsp")
"""Of ``x_c``, ``y_c``, ``m_c``, ``n_c``, ``l_c``, ``s_c`` and ``o_p``."""


def matched_at_key(place: int, camera: int) -> int:
    """Key of ``a_cp``."""
    return int(gtsam.symbol("a", place * MOST_CAMERAS + camera))
