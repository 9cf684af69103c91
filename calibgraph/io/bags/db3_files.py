"""Databases of ROS 2 bags, through sqlite3."""

import sqlite3
from collections.abc import Collection, Iterator
from pathlib import Path

from calibgraph.io.bags.recording import make_topic, topics_by_name

_TABLES = """
    SELECT count(*) FROM sqlite_master
    WHERE type = 'table' AND name IN ('messages', 'topics') AND sql LIKE 'CREATE TABLE %'"""
_TOPICS = """
    SELECT name, type, count(topic_id), serialization_format
    FROM topics LEFT JOIN messages ON topics.id = topic_id GROUP BY topics.id"""
_MESSAGES = """
    SELECT name, timestamp, data FROM messages JOIN topics ON topics.id = topic_id
    WHERE name IN ({}) AND timestamp >= ? AND timestamp < ? ORDER BY timestamp, messages.id"""
_LEAST_LIMIT = 10_000  # of sqlite3, for its statements


class Db3File:
    """A database, open for reading; see :class:`calibgraph.io.bags.recording.Recording`.

    It may be anyone's: it is not written, views and virtual tables are not read, and no value is
    longer than the file.
    """

    def __init__(self, path: Path) -> None:
        name = f"{path.absolute().as_uri()}?immutable=1"  # quotes %, ? and #
        self._database = sqlite3.connect(name, uri=True, check_same_thread=False)
        try:
            self._database.setlimit(
                sqlite3.SQLITE_LIMIT_LENGTH, max(path.stat().st_size, _LEAST_LIMIT)
            )
            if self._database.execute(_TABLES).fetchone() != (2,):
                raise ValueError("it has no tables messages and topics")
            found = self._database.execute(_TOPICS)
            self.topics = topics_by_name(make_topic(*each) for each in found)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close its file."""
        self._database.close()

    def messages(
        self, topics: Collection[str], start_ns: int, stop_ns: int
    ) -> Iterator[tuple[str, int, bytes]]:
        """Topic, time of recording [ns] and bytes of the messages of some topics, by time."""
        query = _MESSAGES.format(", ".join("?" * len(topics)))
        yield from self._database.execute(query, [*topics, start_ns, stop_ns])
