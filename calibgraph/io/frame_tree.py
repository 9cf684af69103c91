"""Trees of frames, as of TF and URDF, and the links in them that a calibration changes.

A camera's optical frame hangs from the robot by several links, and has one parent. So the one of
them that no other camera hangs by is changed, the nearest to the robot's body: a driver may publish
those below it.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.geometry import invert
from calibgraph.model.rig import Mount


class Link(NamedTuple):
    """The (4, 4) pose of a child frame in its parent; a note if it can move, or on its source."""

    parent: str
    child: str
    T_parent_child: Array
    note: str = ""


Links = Mapping[str, Link]
"""By child frame."""


def ancestors(links: Links, frame: str) -> dict[str, Array]:
    """(4, 4) T_ancestor_frame of the frame itself and all above it, nearest first."""
    found, T, above = {frame: np.eye(4)}, np.eye(4), frame
    while above in links and links[above].parent not in found:
        T = links[above].T_parent_child @ T
        above = links[above].parent
        found[above] = T
    return found


def T_between(links: Links, target: str, source: str) -> Array | None:
    """(4, 4) T_target_source through the frame that both hang from; None if there is none."""
    above_target, above_source = ancestors(links, target), ancestors(links, source)
    for frame, T_frame_target in above_target.items():
        if frame in above_source:
            T_target_source: Array = invert(T_frame_target) @ above_source[frame]
            return T_target_source
    return None


def links_between(links: Links, frame: str, other: str) -> list[Link]:
    """The links of the way between two frames that are connected."""
    way = ancestors(links, frame).keys() ^ ancestors(links, other).keys()
    return [links[each] for each in sorted(way)]


def find_mounts(
    cameras: Mapping[str, tuple[str, Array]], lidar: str, links: Links
) -> dict[str, Mount]:
    """The mounts of cameras. A camera below the LiDAR itself, or that shares all links, has none.

    Args:
        cameras: by name, the frame in the tree, and (4, 4) T_camera_frame from it to the camera.
        lidar: the LiDAR's frame, which is connected with all of them.
        links: of the tree.
    """
    above = {name: ancestors(links, frame) for name, (frame, _) in cameras.items()}
    above_lidar = ancestors(links, lidar)
    found = {}
    for name, (frame, T_camera_frame) in cameras.items():
        others = {each for other, way in above.items() if other != name for each in way}
        own = [each for each in above[name] if each in links and each not in others
               and each not in above_lidar]  # fmt: skip
        if not own or links[own[-1]][:2] == (lidar, frame):
            continue
        child, parent = own[-1], links[own[-1]].parent
        T_parent_lidar = T_between(links, parent, lidar)
        if T_parent_lidar is not None:
            T_camera_child = T_camera_frame @ invert(above[name][child])
            found[name] = Mount(
                parent=parent, child=child, T_parent_lidar=T_parent_lidar,
                T_camera_child=T_camera_child,
            )  # fmt: skip
    return found
