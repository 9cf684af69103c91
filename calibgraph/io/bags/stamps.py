"""The stamps of a bag's clouds and images: one pass over the messages, none of which is kept."""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibgraph.io.bags.messages import CLOUDS, Bag, Message
from calibgraph.io.bags.point_clouds import has_points
from calibgraph.io.bags.storage import Stamps
from calibgraph.io.bags.transforms import stamp_ns_of

_S = 1_000_000_000
_IN_EACH = 4
"""Messages of each topic at the start of each ``every_s``: one in the middle has neighbours."""


@dataclass
class TopicStamps:
    """The messages of one topic that can be used, in the order of recording; lists while read.

    Attributes:
        paths: their addresses.
        record_ns: when they were recorded.
        stamp_ns: when they were taken; the same as ``record_ns`` if so chosen.
        cells: in which ``every_s`` of the bag they were recorded.
        fields: of clouds, how many have these fields.
        left_out: how many messages are left out or strange, by the reason.
    """

    paths: list[Path] = field(default_factory=list)
    record_ns: list[int] = field(default_factory=list)
    stamp_ns: list[int] = field(default_factory=list)
    cells: list[int] = field(default_factory=list)
    fields: Counter[tuple[str, ...]] = field(default_factory=Counter)
    left_out: Counter[str] = field(default_factory=Counter)
    _seen: set[int] = field(default_factory=set)
    _frame: str | None = None

    def add(self, message: Message, cell: int, bag: Bag, stamps: Stamps) -> None:
        """Count the message in, or why it is left out."""
        stamp_ns = stamp_ns_of(message.content) if stamps == "header" else message.record_ns
        if stamp_ns in self._seen:
            self.left_out["repeat a stamp"] += 1
            return
        self._seen.add(stamp_ns)
        path, is_cloud = message.path_in(bag.path), bag.topics[message.topic].type in CLOUDS
        frame = message.content.header.frame_id.lstrip("/")
        self._frame = frame if self._frame is None else self._frame
        if frame != self._frame:
            self.left_out[f"name another frame than the first ({frame}, not {self._frame})"] += 1
        if is_cloud and frame != self._frame:
            return
        if is_cloud and not has_points(message.content, str(path)):
            self.left_out["have no point"] += 1
            return
        if is_cloud:
            self.fields[tuple(each.name for each in message.content.fields)] += 1
        if self.stamp_ns and stamp_ns < self.stamp_ns[-1]:
            self.left_out["have a stamp before the last"] += 1
        self.paths.append(path)
        self.record_ns.append(message.record_ns)
        self.stamp_ns.append(stamp_ns)
        self.cells.append(cell)


def read_messages(
    bag: Bag, topics: Collection[str], every_s: float | None, beside: Collection[str] = ()
) -> Iterator[tuple[int, Message]]:
    """The messages of some topics, and which ``every_s`` since the first they are of.

    With ``every_s`` only so many at its start as give each topic a message with neighbours. Times
    in which nothing was recorded are passed over, be they years. ``beside`` are further topics.
    """
    all_topics = {*topics, *beside}
    if every_s is None:
        yield from ((0, message) for message in bag.messages(all_topics))
        return
    every_ns, first_ns, cell = max(1, round(every_s * _S)), bag.next_time(topics), 0
    next_ns = first_ns
    while first_ns is not None and next_ns is not None:
        start_ns = first_ns + cell * every_ns
        wanted = dict.fromkeys(topics, _IN_EACH)
        for message in bag.messages(all_topics, start_ns, start_ns + every_ns):
            yield cell, message
            if message.topic in wanted:
                wanted[message.topic] -= 1
            if max(wanted.values()) <= 0:
                break
        cell += 1
        if min(wanted.values()) == _IN_EACH == max(wanted.values()):
            next_ns = bag.next_time(topics, start_ns + every_ns)
            cell = cell if next_ns is None else (next_ns - first_ns) // every_ns


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
    return after_ns(clouds, images, rows, np.flatnonzero(rows >= 0))


def after_ns(
    clouds: TopicStamps, images: TopicStamps, rows: NDArray[np.int64], chosen: NDArray[np.int64]
) -> NDArray[np.int64]:
    """(n,) by how much the images in ``rows`` are after the chosen ones of their clouds [ns]."""
    stamp_ns = np.array(images.stamp_ns, dtype=np.int64)
    return stamp_ns[rows[chosen]] - np.array(clouds.stamp_ns, dtype=np.int64)[chosen]


def describe_spans(named: Mapping[str, TopicStamps]) -> str:
    """From when to when stamps are, by what they are of."""
    return " and ".join(
        f"{name} {each.stamp_ns[0] / _S:.3f} to {each.stamp_ns[-1] / _S:.3f} s"
        for name, each in named.items()
    )


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
