"""ROS bags without ROS: frames, lenses and transforms from ROS 1 and ROS 2 bags (sqlite3, MCAP).

The rest of the package reads a message as it reads a file: by the path that is its address.
"""

import hashlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import FileError
from calibgraph.io.bags.messages import MESSAGE_SUFFIX as MESSAGE_SUFFIX
from calibgraph.io.bags.messages import read_message
from calibgraph.io.bags.pictures import image_from_message
from calibgraph.io.bags.point_clouds import points_of
from calibgraph.io.bags.storage import BagOptions as BagOptions
from calibgraph.io.bags.storage import is_bag as is_bag
from calibgraph.io.bags.transforms import stamp_ns_of


def load_bag_cloud(
    path: Path, *, timed: bool = False, start_ns: int | None = None
) -> tuple[NDArray[np.float32], Array | None]:
    """(n, 4) the cloud in the message with this address, and (n,) its points' times, if asked.

    They are seconds after a stamp, by default its own; None if points have no times.
    """
    content = read_message(path)[1]
    cloud, times_s = points_of(content, str(path), timed=timed)
    if not len(cloud):
        raise FileError(path, "holds no point")
    if times_s is not None and start_ns is not None:
        times_s = times_s + (stamp_ns_of(content) - start_ns) / 1e9
    return cloud, times_s


def scan_duration_s(path: Path) -> float | None:
    """Seconds between the first and the last point of a cloud in a message; None without times."""
    times_s = points_of(read_message(path)[1], str(path), timed=True)[1]
    return None if times_s is None or not len(times_s) else float(np.ptp(times_s))


def load_bag_image(path: Path) -> NDArray[np.uint8]:
    """(height, width, 3) the image in the message with this address, BGR."""
    return image_from_message(read_message(path)[1], str(path))


def hash_message(path: Path) -> str:
    """SHA-256 of the bytes of the message with this address."""
    return hashlib.sha256(read_message(path)[0]).hexdigest()
