"""The static transforms of a bag, as a graph of frames.

A TransformStamped maps the child's coordinates to the parent's: p_parent = T_parent_child p_child,
with the parent in ``header.frame_id``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibgraph.io.bags.messages import TRANSFORMS, Bag
from calibgraph.model.geometry import invert

Array = NDArray[np.float64]
Tree = Mapping[str, tuple[str, Array]]
"""Per child frame its parent and the (4, 4) T_parent_child."""

_STATIC_TOPIC = "tf_static"


def static_tree(bag: Bag) -> Tree:
    """The static transforms of a bag; of several for one child, the last, as tf does."""
    names = [t.name for t in bag.of_type(TRANSFORMS) if t.name.split("/")[-1] == _STATIC_TOPIC]
    tree: dict[str, tuple[str, Array]] = {}
    for message in bag.messages(names):
        for stamped in message.content.transforms:
            child, parent = stamped.child_frame_id, stamped.header.frame_id
            tree[child.lstrip("/")] = (
                parent.lstrip("/"),
                matrix_of(stamped.transform.translation, stamped.transform.rotation),
            )
    return tree


def transform_between(tree: Tree, target: str, source: str) -> Array | None:
    """(4, 4) T_target_source through the frame that both hang from; None if there is none."""
    above_target, above_source = _ancestors(tree, target), _ancestors(tree, source)
    for frame, T_frame_target in above_target.items():
        if frame in above_source:
            T_target_source: Array = invert(T_frame_target) @ above_source[frame]
            return T_target_source
    return None


def _ancestors(tree: Tree, frame: str) -> dict[str, Array]:
    """(4, 4) T_ancestor_frame of the frame itself and all above it, nearest first."""
    found, T = {frame: np.eye(4)}, np.eye(4)
    above = frame
    while above in tree and tree[above][0] not in found:
        above, T_parent_child = tree[above]
        T = T_parent_child @ T
        found[above] = T
    return found


def matrix_of(shift: Any, turn: Any) -> Array:
    """(4, 4) of a geometry_msgs Vector3 or Point, and a Quaternion."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    T[:3, 3] = shift.x, shift.y, shift.z
    return T
