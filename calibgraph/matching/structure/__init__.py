"""The weight-free matcher `structure`: local correlation of clouds and images, pose consensus.

First every camera is found, from a guess that may be far off:

1. ``responses``: small windows of LiDAR points, and what varies in them, inverse range and
   intensity; how well the image agrees with them at all its places.
2. ``search``: the poses at which they agree best together.
3. ``locate``: which of these, if any, is good enough to begin from; cameras help each other.

Then per round, from the present estimate of the poses:

1. ``windows``: the windows that the camera would see.
2. ``scores``: how well the image under each window, at every shift of a grid, agrees with it; the
   windows of one direction and depth are one group.
3. ``consensus``: the pose at which the groups' shifts agree best.
4. ``peaks``: every group's own best shift next to it, with the directions that it constrains: one
   correspondence each.

Shifts and resolutions are angles, so that one schedule of rounds serves every focal length. Nothing
depends on the order of the points in a file, or on rings.
"""

from calibgraph.matching.structure.matcher import StructureMatcher

__all__ = ["StructureMatcher"]
