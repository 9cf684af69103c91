"""Spoilt databases, each opened by a process of its own: one line or a tracker, and no more."""

from __future__ import annotations

import os
import random
import resource
import signal
import sqlite3
import sys
import time
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import pytest

from calibgraph import DurableCalibrator, Rig
from calibgraph.errors import CalibrationError
from calibgraph.tracking.state_database import DATABASE
from calibgraph.tracking.state_recovery import TABLES, checksum
from tests.tracking.drives import World
from tests.tracking.state_data import LOG, Files, content, restored

CASES = int(os.environ.get("CALIBGRAPH_TEST_FUZZ", "300"))
MOST_S, MOST_BYTES = 20.0, 200e6  # the time of a machine under load, and the memory of one more
PAGE = 32768
VALUES = ("NULL", "-1", "1e308", "9223372036854775807", "'text'", "zeroblob(10000000)", "x'00'")
EXPRESSIONS = ("hex(zeroblob(100000000))", "randomblob(100000000)", "load_extension('x')")


def flip(rng: random.Random, data: bytearray) -> None:
    for _ in range(rng.choice((1, 1, 3, 30))):
        data[rng.randrange(rng.choice((100, 4 * PAGE, len(data))) % len(data) or 1)] = (
            rng.randrange(256)
        )


def cut(rng: random.Random, data: bytearray) -> None:
    del data[rng.randrange(len(data)) :]


def swap_pages(rng: random.Random, data: bytearray) -> None:
    a, b = (PAGE * rng.randrange(len(data) // PAGE) for _ in range(2))
    data[a : a + PAGE], data[b : b + PAGE] = data[b : b + PAGE], data[a : a + PAGE]


def repeat_page(rng: random.Random, data: bytearray) -> None:
    at = PAGE * rng.randrange(len(data) // PAGE)
    data[PAGE:] = data[at : at + PAGE] * rng.choice((1, 3, 300))


BYTES = (flip, flip, flip, cut, swap_pages, repeat_page)


def change_a_value(rng: random.Random, database: sqlite3.Connection) -> None:
    table = rng.choice([*TABLES])
    columns = [column.split()[0] for column in TABLES[table].strip("()").split(",")]
    database.execute(f"UPDATE {table} SET {rng.choice(columns)} = {rng.choice(VALUES)}")


def change_the_schema(rng: random.Random, database: sqlite3.Connection) -> None:
    table, value = rng.choice([*TABLES]), rng.choice(EXPRESSIONS)
    event = rng.choice(("INSERT", "UPDATE", "DELETE"))
    database.execute(
        rng.choice(
            (
                f"CREATE TRIGGER t AFTER {event} ON {table} BEGIN SELECT {value}; END",
                f"CREATE INDEX i ON {table} ({value.replace('randomblob', 'zeroblob')})",
                f"ALTER TABLE {table} ADD COLUMN c AS ({value})",
                f"ALTER TABLE {table} RENAME TO other",
                f"CREATE VIEW v AS SELECT {value}",
                f"DROP TABLE {table}",
            )
        )
    )


def change_the_schema_by_hand(rng: random.Random, database: sqlite3.Connection) -> None:
    database.execute("PRAGMA writable_schema=ON")
    column, value = rng.choice(("type", "name", "sql", "rootpage")), rng.choice((*VALUES, "2", "3"))
    table = rng.choice([*TABLES])
    database.execute(f"UPDATE sqlite_schema SET {column} = {value} WHERE name = '{table}'")


def change_a_state(rng: random.Random, database: sqlite3.Connection) -> None:
    """With a right checksum: what reads the bytes has to notice."""
    table = rng.choice(("snapshot", "journal"))
    rows = database.execute(f"SELECT number, content FROM {table} ORDER BY number DESC").fetchall()
    number, data = rows[0][0], bytearray(rows[0][1])
    rng.choice((flip, flip, cut))(rng, data)
    changed = bytes(data), checksum(number, bytes(data)), number
    database.execute(f"UPDATE {table} SET content = ?, digest = ? WHERE number = ?", changed)


STATEMENTS = (change_a_value, change_the_schema, change_the_schema_by_hand, change_a_state)


def spoil(rng: random.Random, folder: Path) -> str:
    """Change the database, its log, or what lies beside it; returns how."""
    if rng.random() < 0.5:
        change: Callable[..., None] = rng.choice(BYTES)
        path = folder / rng.choice((DATABASE, DATABASE, LOG))
        data = bytearray(path.read_bytes())
        change(rng, data)
        path.write_bytes(data)
    else:
        change = rng.choice(STATEMENTS)
        with (
            closing(sqlite3.connect(folder / DATABASE, isolation_level=None)) as database,
            suppress(sqlite3.Error),
        ):
            change(rng, database)
    for name in ("journal", "shm"):
        if rng.random() < 0.1:
            (folder / f"{DATABASE}-{name}").write_bytes(rng.randbytes(5000))
    return change.__name__


def open_in_a_child(folder: Path, rig: Rig, world: World) -> tuple[str, float, int]:
    """The answer of a fork: opened, a line, or how it died; its seconds and bytes of memory."""
    read, write = os.pipe()
    start, child = time.monotonic(), os.fork()
    if child == 0:
        signal.alarm(round(MOST_S))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        answer = "an exception of another kind"
        try:
            with DurableCalibrator(folder, rig) as calibrator:
                calibrator.update(world.tables[6])
            answer = "opened"
        except (CalibrationError, OSError) as error:
            answer = f"{type(error).__name__}: {error}"
        except BaseException as error:
            answer = f"{answer}: {error!r}"
        os.write(write, answer.encode()[:2000])
        os._exit(0)
    os.close(write)
    with open(read, "rb") as pipe:
        answer = pipe.read().decode()
    _, status, used = os.wait4(child, 0)
    if status:
        answer = f"died of {signal.Signals(status & 0x7F).name}"
    scale = 1 if sys.platform == "darwin" else 1024
    return answer, time.monotonic() - start, used.ru_maxrss * scale


@pytest.mark.slow
def test_a_spoilt_database_is_opened_or_refused_in_one_line(world: World, memory: Path) -> None:
    with DurableCalibrator(memory / "state", world.guess) as calibrator:
        for table in world.tables[:6]:
            calibrator.update(table)
            files: Files = content(memory / "state")  # with its log, as a kill leaves it
    answers, before = dict[str, int](), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    longest, largest = 0.0, 0
    for seed in range(CASES):
        rng = random.Random(seed)
        how = spoil(rng, restored(memory / "copy", files))
        answer, seconds, size = open_in_a_child(memory / "copy", world.guess, world)
        assert answer == "opened" or answer.startswith(("FileError: ", "OSError: ")), (
            seed,
            how,
            answer,
        )
        assert "\n" not in answer and answer.isprintable(), (seed, how, answer)
        assert size < before + MOST_BYTES, (seed, how, answer)
        answers[answer.split(":")[0]] = answers.get(answer.split(":")[0], 0) + 1
        longest, largest = max(longest, seconds), max(largest, size)
    print(answers, f"at most {longest:.2f} s, {largest / 1e6:.0f} MB of {before / 1e6:.0f}")
    assert answers["opened"] > CASES / 50 and answers["FileError"] > CASES / 4
