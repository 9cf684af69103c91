"""ROS bags without ROS: frames, lenses and transforms from ROS 1 and ROS 2 bags (sqlite3, MCAP).

The rest of the package reads a message as it reads a file: by the path that is its address.
"""

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import FileError
from calibgraph.io.bags.messages import MESSAGE_SUFFIX as MESSAGE_SUFFIX
from calibgraph.io.bags.messages import read_message
from calibgraph.io.bags.pictures import image_from_message
from calibgraph.io.bags.point_clouds import cloud_from_message, timed_points_of
from calibgraph.io.bags.storage import BagOptions as BagOptions
from calibgraph.io.bags.storage import is_bag as is_bag
from calibgraph.io.bags.transforms import stamp_ns_of

Correction = Callable[[NDArray[np.float32], Array], Array]
"""Of (n, 3) points for motion, by (n,) times after the stamp [s]."""


def load_bag_cloud(path: Path, correct: Correction | None = None) -> NDArray[np.float32]:
    """(n, 4) the cloud in the message with this address, corrected for motion if it is given."""
    content = read_message(path)[1]
    if correct is None:
        cloud = cloud_from_message(content, str(path))
    else:
        cloud, times_s = timed_points_of(content, str(path))
        cloud[:, :3] = correct(cloud[:, :3], np.zeros(len(cloud)) if times_s is None else times_s)
    if not len(cloud):
        raise FileError(path, "holds no point")
    return cloud


def load_timed_bag_cloud(
    path: Path, start_ns: int | None
) -> tuple[NDArray[np.float32], Array | None]:
    """(n, 4) the cloud in a message, and its points' times [s] after another stamp, if any."""
    content = read_message(path)[1]
    if start_ns is None:
        return load_bag_cloud(path), None
    cloud, times_s = timed_points_of(content, str(path))
    late_s = (stamp_ns_of(content) - start_ns) / 1e9
    return cloud, None if times_s is None else times_s + late_s


def scan_duration_s(path: Path) -> float | None:
    """Seconds between the first and the last point of a cloud in a message; None without times."""
    times_s = timed_points_of(read_message(path)[1], str(path))[1]
    return None if times_s is None or not len(times_s) else float(np.ptp(times_s))


def load_bag_image(path: Path) -> NDArray[np.uint8]:
    """(height, width, 3) the image in the message with this address, BGR."""
    return image_from_message(read_message(path)[1], str(path))


def hash_message(path: Path) -> str:
    """SHA-256 of the bytes of the message with this address."""
    return hashlib.sha256(read_message(path)[0]).hexdigest()
