"""Keys of the variables: ``Pose3`` in the LiDAR frame; scan distortion and lenses are vectors.

x_c   the mount of camera c: ``T_lidar_camera`` of the two sensors as bodies
d     the scan distortion, in standard deviations of its prior
y_c   the alignment of camera c: where the points, as the LiDAR delivers them, meet its image
b_c   the mount of camera c if its lens errs as that of a calibrated one, where mounts are reported
m_c   camera c as its matches show it at every place
n_c   camera c as its pairs with other cameras show it
o     the cloud as it is displaced at every place
o_p   the cloud as it is displaced at place p
a_cp  camera c as its matches at place p show it
l_c   the lens of camera c, if it is estimated, in standard deviations of its prior
s_c   that lens as its matches show it
"""

import gtsam

CLOUD = int(gtsam.symbol("o", 0))
DISTORTION = int(gtsam.symbol("d", 0))

MOST_CAMERAS = 1000
"""``a3002`` is camera 2 at place 3."""


def camera_key(camera: int) -> int:
    """Key of ``x_c``."""
    return int(gtsam.symbol("x", camera))


def aligned_key(camera: int) -> int:
    """Key of ``y_c``."""
    return int(gtsam.symbol("y", camera))


def body_key(camera: int) -> int:
    """Key of ``b_c``."""
    return int(gtsam.symbol("b", camera))


def matched_key(camera: int) -> int:
    """Key of ``m_c``."""
    return int(gtsam.symbol("m", camera))


def paired_key(camera: int) -> int:
    """Key of ``n_c``."""
    return int(gtsam.symbol("n", camera))


def lens_key(camera: int) -> int:
    """Key of ``l_c``."""
    return int(gtsam.symbol("l", camera))


def seen_lens_key(camera: int) -> int:
    """Key of ``s_c``."""
    return int(gtsam.symbol("s", camera))


def cloud_at_key(place: int) -> int:
    """Key of ``o_p``."""
    return int(gtsam.symbol("p", place))


def matched_at_key(place: int, camera: int) -> int:
    """Key of ``a_cp``."""
    return int(gtsam.symbol("a", place * MOST_CAMERAS + camera))
