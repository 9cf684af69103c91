"""The transforms of a robot's tree that a calibration changes, one for each camera.

A camera's optical frame hangs from the robot by several transforms, and has one parent. So the
one of them that no other camera hangs by is changed, the nearest to the robot's body: a driver may
publish those below it.
"""

from collections.abc import Callable, Mapping

from calibgraph.arrays import Array
from calibgraph.model.rig import Mount


def find_mounts(
    cameras: Mapping[str, tuple[str, Array]],
    lidar: str,
    parents: Mapping[str, str],
    T_between: Callable[[str, str], Array],
) -> dict[str, Mount]:
    """The mounts of cameras; none of those that hang from the LiDAR itself, or share all links.

    Args:
        cameras: by name, the frame in the tree, and (4, 4) T_camera_frame from it to the camera.
        lidar: the LiDAR's frame, which is connected with all of them.
        parents: of the frames, by child.
        T_between: (4, 4) T_target_source of two frames.
    """
    above_lidar = {*_way(lidar, set(), parents)}
    ways = {name: _way(frame, above_lidar, parents) for name, (frame, _) in cameras.items()}
    found = {}
    for name, (frame, T_camera_frame) in cameras.items():
        others = {each for other, way in ways.items() if other != name for each in way}
        own = [each for each in ways[name] if each not in others and each in parents]
        if not own or (parents[own[-1]], own[-1]) == (lidar, frame):
            continue
        child, parent = own[-1], parents[own[-1]]
        found[name] = Mount(
            parent=parent,
            child=child,
            T_parent_lidar=T_between(parent, lidar),
            T_camera_child=T_camera_frame @ T_between(frame, child),
        )
    return found


def _way(frame: str, until: set[str], parents: Mapping[str, str]) -> list[str]:
    """A frame and those above it, the nearest first, up to one that is in ``until``."""
    way: list[str] = []
    while frame not in until and frame not in way:
        way.append(frame)
        if frame not in parents:
            break
        frame = parents[frame]
    return way
