"""The static transforms of a drive, as a graph of frames.

A TransformStamped maps the child's coordinates to the parent's: p_parent = T_parent_child p_child,
with the parent in ``header.frame_id``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.io.bags.messages import TREES, Bag
from calibgraph.io.rig_parts import Link, T_between, ancestors, links_between
from calibgraph.model.geometry import transform

STATIC, MOVING = "tf_static", "tf"
_LEAST_LENGTH = 1e-6  # of a quaternion that is one
_SAME = 1e-6  # of the entries of a transform that does not change


@dataclass
class _Tree:
    """Links, with notes on their source if it is not the own bag; and why frames are left out."""

    links: dict[str, Link] = field(default_factory=dict)
    invalid: dict[str, str] = field(default_factory=dict)
    moving: set[str] = field(default_factory=set)

    def widened(self, *others: _Tree) -> _Tree:
        """With what others have of frames that are missing here; of several, the first counts."""
        found = _Tree()
        for tree in (*reversed(others), self):
            found.links |= tree.links
            found.invalid |= tree.invalid
            found.moving |= tree.moving
        return found


class Transforms:
    """The static transforms of a bag, the first of its drive.

    Where they do not connect two frames, those of other bags of the drive serve, and then those on
    /tf that never change, as ROS 1 may have them.
    """

    def __init__(self, drive: Sequence[Bag]) -> None:
        self._drive = drive
        self._read = cache(_read_tree)  # once, and only as far as trees are needed
        self._used: dict[str, set[str]] = {}
        self.links: dict[str, Link] = {}  # of the trees that were needed

    def _trees(self) -> Iterator[_Tree]:
        """Wider and wider trees: of the bag, with another bag, ..., with /tf of all."""
        tree = self._read(self._drive[0], STATIC, "")
        yield tree
        for bag in self._drive[1:]:
            tree = tree.widened(self._read(bag, STATIC, f"/{STATIC} of {bag.path}"))
            yield tree
        never = "/{} of {}, on which they never change"
        yield tree.widened(
            *(self._read(bag, MOVING, never.format(MOVING, bag.path)) for bag in self._drive)
        )

    def between(self, target: str, source: str) -> Array | None:
        """(4, 4) T_target_source through the frame that both hang from; None if there is none."""
        for tree in self._trees():
            T_target_source = T_between(tree.links, target, source)
            if T_target_source is not None:
                self.links |= tree.links
                for link in links_between(tree.links, target, source):
                    self._used.setdefault(link.note, set()).add(link.child)
                return T_target_source
        return None

    @property
    def moving(self) -> set[str]:
        """The frames on /tf that move against their parents."""
        *_, widest = self._trees()
        return widest.moving

    @property
    def notes(self) -> list[str]:
        """A line for each transform that was left out, and each source beside /tf_static."""
        left_out = [f"{why}; it is left out" for why in next(self._trees()).invalid.values()]
        used = [
            f"{self._drive[0].path}: the transforms of {_listed(frames)} are from {source}"
            for source, frames in self._used.items()
            if source
        ]
        return [*left_out, *used]

    def why_apart(self, *frames: str) -> str:
        """Why frames are not connected, and which frames there are."""
        *_, tree = self._trees()
        for frame in frames:
            *_, top = ancestors(tree.links, frame)
            if top in tree.invalid:
                return f"{tree.invalid[top]}, and {frame!r} hangs by it"
        moving = f"; {_listed(tree.moving)} move on /{MOVING}" if tree.moving else ""
        return f"its frames are {_listed({*tree.links})}{moving}"


def _listed(frames: set[str]) -> str:
    return ", ".join(sorted(frames)) or "none"


def _read_tree(bag: Bag, name: str, source: str) -> _Tree:
    """The last transform to each child, as in tf; on /tf, those that are the same throughout."""
    tree = _Tree()
    for each in stamped_transforms(bag, name):
        if each.T_parent_child is None:
            tree.invalid[each.child] = each.text
            continue
        link = Link(each.parent, each.child, each.T_parent_child, source)
        first = tree.links.setdefault(each.child, link)
        change = np.abs(link.T_parent_child - first.T_parent_child).max()
        if name == STATIC:
            tree.links[each.child] = link
        elif link.parent != first.parent or change > _SAME:
            tree.moving.add(each.child)
    for child in tree.moving:
        del tree.links[child]
    return tree


class StampedTransform(NamedTuple):
    """A TransformStamped; (4, 4) T_parent_child is None, and the text why, if it is none."""

    parent: str
    child: str
    stamp_ns: int
    T_parent_child: Array | None
    text: str


def stamped_transforms(bag: Bag, name: str) -> Iterator[StampedTransform]:
    """The transforms on all topics of a bag with this last name."""
    topics = [each.name for each in bag.of_type(*TREES) if each.name.split("/")[-1] == name]
    for message in bag.messages(topics):
        for each in message.content.transforms:
            child = each.child_frame_id.lstrip("/")
            shift, turn = values_of(each.transform.translation, each.transform.rotation)
            T = pose_matrix(shift, turn)
            text = "" if T is not None else (
                f"{bag.path}: the transform of frame {child!r} on {message.topic} has the "
                f"translation {shift} and the quaternion {turn}"
            )  # fmt: skip
            parent = each.header.frame_id.lstrip("/")
            yield StampedTransform(parent, child, stamp_ns_of(each), T, text)


def values_of(shift: Any, turn: Any) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """The numbers of a geometry_msgs Vector3 or Point, and of a Quaternion: x y z w."""
    return (shift.x, shift.y, shift.z), (turn.x, turn.y, turn.z, turn.w)


def pose_matrix(shift: Sequence[float], turn: Sequence[float]) -> Array | None:
    """(4, 4) of a translation and a quaternion x y z w; None if they are none: 0 0 0 0, or NaN."""
    length = float(np.linalg.norm(turn))
    if not (np.isfinite([*shift, length]).all() and length > _LEAST_LENGTH):
        return None
    return transform(Rotation.from_quat(turn), shift)


def stamp_ns_of(stamped: Any) -> int:
    """The stamp of a message's header in nanoseconds."""
    stamp = stamped.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
