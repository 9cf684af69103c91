"""The static transforms of a drive, as a graph of frames.

A TransformStamped maps the child's coordinates to the parent's: p_parent = T_parent_child p_child,
with the parent in ``header.frame_id``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.io.bags.messages import TREES, Bag
from calibgraph.io.rig_parts import Link, T_between, ancestors, links_between
from calibgraph.model.geometry import transform

STATIC, MOVING = "tf_static", "tf"
_LEAST_LENGTH = 1e-6  # of a quaternion that is one
_SAME = 1e-6  # of the entries of a transform that does not change


class Transforms:
    """The static transforms of a bag, the first of its drive.

    Where they do not connect two frames, those of other bags of the drive serve, and then those on
    /tf that never change, as ROS 1 may have them. Each is read only when it is needed.

    Attributes:
        links: those that were read; of several for a frame, the first counts.
    """

    def __init__(self, drive: Sequence[Bag]) -> None:
        self._path = drive[0].path
        self._unread = [
            (bag, STATIC, "" if bag is drive[0] else f"/{STATIC} of {bag.path}") for bag in drive
        ]
        never = "/{} of {}, on which they never change"
        self._unread += [(bag, MOVING, never.format(MOVING, bag.path)) for bag in drive]
        self.links: dict[str, Link] = {}
        self._invalid: dict[str, str] = {}  # why frames are left out
        self._moving: set[str] = set()
        self._used: dict[str, set[str]] = {}
        self._read_next()
        self._left_out = [f"{why}; it is left out" for why in self._invalid.values()]

    def _read_next(self) -> None:
        links, invalid, moving = _read_tree(*self._unread.pop(0))
        self.links, self._invalid = links | self.links, invalid | self._invalid
        self._moving |= moving

    def between(self, target: str, source: str) -> Array | None:
        """(4, 4) T_target_source through the frame that both hang from; None if there is none."""
        while (T := T_between(self.links, target, source)) is None and self._unread:
            self._read_next()
        if T is not None:
            for link in links_between(self.links, target, source):
                self._used.setdefault(link.note, set()).add(link.child)
        return T

    @property
    def moving(self) -> set[str]:
        """The frames on /tf that move against their parents."""
        while self._unread:
            self._read_next()
        return self._moving

    @property
    def notes(self) -> list[str]:
        """A line for each transform that was left out, and each source beside /tf_static."""
        used = [
            f"{self._path}: the transforms of {_listed(frames)} are from {source}"
            for source, frames in self._used.items()
            if source
        ]
        return [*self._left_out, *used]

    def why_apart(self, *frames: str) -> str:
        """Why frames are not connected, and which frames there are."""
        moving = f"; {_listed(self.moving)} move on /{MOVING}" if self.moving else ""
        for frame in frames:
            *_, top = ancestors(self.links, frame)
            if top in self._invalid:
                return f"{self._invalid[top]}, and {frame!r} hangs by it"
        return f"its frames are {_listed({*self.links})}{moving}"


def _listed(frames: set[str]) -> str:
    return ", ".join(sorted(frames)) or "none"


def _read_tree(
    bag: Bag, name: str, source: str
) -> tuple[dict[str, Link], dict[str, str], set[str]]:
    """By child: the last transform to each, as in tf; why others are none; and which move.

    On /tf, those that are the same throughout. The source is noted on each link.
    """
    links, invalid, moving = dict[str, Link](), dict[str, str](), set[str]()
    for _, child, found in stamped_transforms(bag, name):
        if isinstance(found, str):
            invalid[child] = found
            continue
        link = found._replace(note=source)
        first = links.setdefault(child, link)
        change = np.abs(link.T_parent_child - first.T_parent_child).max()
        if name == STATIC:
            links[child] = link
        elif link.parent != first.parent or change > _SAME:
            moving.add(child)
    for child in moving:
        del links[child]
    return links, invalid, moving


def stamped_transforms(bag: Bag, name: str) -> Iterator[tuple[int, str, Link | str]]:
    """The transforms on all topics of a bag with this last name.

    Each with its stamp [ns] and its child frame; in place of one that is none, why.
    """
    topics = [each.name for each in bag.of_type(*TREES) if each.name.split("/")[-1] == name]
    for message in bag.messages(topics):
        for each in message.content.transforms:
            child, parent = each.child_frame_id.lstrip("/"), each.header.frame_id.lstrip("/")
            shift, turn = values_of(each.transform.translation, each.transform.rotation)
            T = pose_matrix(shift, turn)
            found = Link(parent, child, T) if T is not None else (
                f"{bag.path}: the transform of frame {child!r} on {message.topic} has the "
                f"translation {shift} and the quaternion {turn}"
            )  # fmt: skip
            yield stamp_ns_of(each), child, found


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
