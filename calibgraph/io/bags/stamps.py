"""The stamps of a bag's clouds and images: one pass over the messages, none of which is kept."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibgraph.io.bags.messages import CLOUDS, Bag, Message
from calibgraph.io.bags.options import Stamps
from calibgraph.io.bags.point_clouds import has_points
from calibgraph.io.bags.transforms import stamp_ns_of

_S = 1_000_000_000


@dataclass
class TopicStamps:
    """The messages of one topic that can be used, in the order of recording; lists while read.

    Attributes:
        paths: their addresses.
        record_ns: when they were recorded.
        stamp_ns: when they were taken; the same as ``record_ns`` if so chosen.
        repeated: number of messages left out because their stamp had been seen.
        empty: number of clouds left out because they have no point.
        back: how often a stamp was earlier than the one before.
    """

    paths: list[Path] = field(default_factory=list)
    record_ns: list[int] = field(default_factory=list)
    stamp_ns: list[int] = field(default_factory=list)
    repeated: int = 0
    empty: int = 0
    back: int = 0
    _seen: set[int] = field(default_factory=set)

    def add(self, message: Message, bag: Bag, stamps: Stamps) -> None:
        """Count the message in, or why it is left out."""
        stamp_ns = stamp_ns_of(message.content) if stamps == "header" else message.record_ns
        if stamp_ns in self._seen:
            self.repeated += 1
            return
        self._seen.add(stamp_ns)
        path = message.path_in(bag.path)
        is_cloud = bag.topics[message.topic].type in CLOUDS
        if is_cloud and not has_points(message.content, str(path)):
            self.empty += 1
            return
        self.back += bool(self.stamp_ns) and stamp_ns < self.stamp_ns[-1]
        self.paths.append(path)
        self.record_ns.append(message.record_ns)
        self.stamp_ns.append(stamp_ns)


def read_stamps(
    bag: Bag, topics: Collection[str], windows: Iterable[tuple[int, int]], stamps: Stamps
) -> dict[str, TopicStamps]:
    """The stamps of some topics within windows of recording time [ns], one after another."""
    found = {topic: TopicStamps() for topic in topics}
    for start_ns, stop_ns in windows:
        for message in bag.messages(topics, start_ns, stop_ns):
            found[message.topic].add(message, bag, stamps)
    return found


def windows_of(bag: Bag, topics: Collection[str], every_s: float | None) -> list[tuple[int, int]]:
    """From when to when to read messages [ns]: all, or a window at the start of each ``every_s``.

    A window is four periods of the slowest topic long, so that each topic has a message with
    neighbours in it.
    """
    if every_s is None:
        return [(bag.start_ns, bag.stop_ns)]
    every_ns, fewest = to_every_ns(every_s), min(bag.topics[topic].count for topic in topics)
    length = min(every_ns, 4 * (bag.stop_ns - bag.start_ns) // fewest)
    return [
        (start, min(start + length, bag.stop_ns))
        for start in range(bag.start_ns, bag.stop_ns, every_ns)
    ]


def to_every_ns(every_s: float) -> int:
    """The seconds between frames in nanoseconds, at least one."""
    return max(1, round(every_s * _S))


_USUAL_M_S = 10.0


def describe_offsets(name: str, offsets_ns: NDArray[np.int64]) -> str:
    """By how much the images of a camera are after their clouds, and what that costs at speed."""
    ms = offsets_ns / 1e6
    median = float(np.median(ms))
    text = f"{name} {median:+.0f} ms (median), at most {np.abs(ms).max():.0f}"
    return f"{text}: {abs(median) / 1e3 * _USUAL_M_S:.2f} m at {_USUAL_M_S:g} m/s"


def offsets_of(clouds: TopicStamps, images: TopicStamps) -> NDArray[np.int64]:
    """(n,) by how much the nearest image is after each cloud within a second of one [ns]."""
    rows = nearest(clouds, images, _S)
    found = np.flatnonzero(rows >= 0)
    stamp_ns = np.array(images.stamp_ns, dtype=np.int64)
    return stamp_ns[rows[found]] - np.array(clouds.stamp_ns, dtype=np.int64)[found]


def nearest(clouds: TopicStamps, images: TopicStamps, tolerance_ns: int) -> NDArray[np.int64]:
    """(n,) for each cloud the image with the nearest stamp, -1 if none is within the tolerance.

    Only messages recorded within a second of each other are compared: after a clock was set back,
    the same stamps come again.
    """
    record_ns, stamp_ns = np.array(images.record_ns), np.array(images.stamp_ns)
    first = np.searchsorted(record_ns, np.array(clouds.record_ns) - _S)
    last = np.searchsorted(record_ns, np.array(clouds.record_ns) + _S, side="right")
    chosen = np.full(len(clouds.paths), -1)
    for cloud, (start, stop) in enumerate(zip(first, last, strict=True)):
        apart = np.abs(stamp_ns[start:stop] - clouds.stamp_ns[cloud])
        if len(apart) and apart.min() <= tolerance_ns:
            chosen[cloud] = start + int(np.argmin(apart))
    return chosen
