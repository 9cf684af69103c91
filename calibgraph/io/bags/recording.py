"""What every kind of bag is to its readers: topics, and messages as bytes in order of recording."""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

ENCODINGS = ("cdr", "ros1")
"""How messages of ROS 2 and of ROS 1 are serialized."""


@dataclass(frozen=True)
class Topic:
    """A topic of a bag; the type names the encoding if that is none of ROS."""

    name: str
    type: str
    count: int
    encoding: str = "cdr"


class Recording(Protocol):
    """An open bag; ``topics`` are by name."""

    topics: dict[str, Topic]

    def messages(
        self, topics: Collection[str], start_ns: int, stop_ns: int
    ) -> Iterator[tuple[str, int, bytes]]:
        """Topic, time of recording [ns] and bytes of the messages of some topics, by time.

        Args:
            topics: names.
            start_ns: when the first was recorded at the earliest [ns].
            stop_ns: before which the last was recorded [ns].
        """
        ...

    def close(self) -> None:
        """Close its files."""
        ...


def make_topic(name: str, type_: str, count: int, encoding: str) -> Topic:
    """A topic; a type of ROS 1 gets the name that it has in ROS 2."""
    if encoding not in ENCODINGS:
        return Topic(name, f"{type_} ({encoding or 'of no encoding'})", count, encoding)
    package, _, last = type_.rpartition("/")
    is_short = package and not package.endswith("/msg")
    return Topic(name, f"{package}/msg/{last}" if is_short else type_, count, encoding)


def topics_by_name(topics: Iterable[Topic]) -> dict[str, Topic]:
    """Topics, sorted by name; with the messages of all their publishers, files and types."""
    found: dict[str, Topic] = {}
    for each in sorted(topics, key=lambda topic: topic.name):
        before = found.get(each.name, each)
        same = (before.type, before.encoding) == (each.type, each.encoding)
        type_ = each.type if same else f"{before.type}, {each.type}"
        earlier = before.count if each.name in found else 0
        found[each.name] = Topic(each.name, type_, earlier + each.count, each.encoding)
    return found
