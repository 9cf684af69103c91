"""Tables of results: printed, and kept as JSON lines with the commit and command they are of."""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path

ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).parent / "results"
"""A file per benchmark, of which ``benchmarks.results`` writes ``benchmarks/notes/results.md``."""


@dataclass(frozen=True)
class Table:
    """A table of results.

    Attributes:
        title: what was measured.
        columns: heads, with units.
        rows: the cells, as text.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def text(self) -> str:
        """Aligned columns, for a terminal."""
        lines = [self.columns, *self.rows]
        widths = [max(len(line[i]) for line in lines) for i in range(len(self.columns))]
        aligned = ("  ".join(_aligned(line, widths)).rstrip() for line in lines)
        return "\n".join([self.title, *aligned])

    def markdown(self) -> str:
        """A table in Markdown."""
        rule = ("---",) * len(self.columns)
        lines = (f"| {' | '.join(line)} |" for line in (self.columns, rule, *self.rows))
        return "\n".join([f"{self.title}:", "", *lines])


def _aligned(line: Sequence[str], widths: Sequence[int]) -> Iterator[str]:
    """The first column to the left, numbers to the right."""
    for index, (cell, width) in enumerate(zip(line, widths, strict=True)):
        yield cell.ljust(width) if index == 0 else cell.rjust(width)


@dataclass(frozen=True)
class Entry:
    """One run of a benchmark.

    Attributes:
        commit: short hash of the checkout, with ``+`` if the code had uncommitted changes.
        date: of the run.
        command: as it was called.
        machine: processor architecture and number of cores.
        tables: its results.
    """

    commit: str
    date: str
    command: str
    machine: str
    tables: tuple[Table, ...]

    @staticmethod
    def from_json(line: str) -> Entry:
        """Decode a line of a results file."""
        content = json.loads(line)
        tables = tuple(
            Table(t["title"], tuple(t["columns"]), tuple(map(tuple, t["rows"])))
            for t in content.pop("tables")
        )
        return Entry(**content, tables=tables)


def parser_of(description: str | None) -> argparse.ArgumentParser:
    """The options that every benchmark has: ``--record``."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--record", action="store_true", help="append the tables to benchmarks/results"
    )
    return parser


def publish(benchmark: str, tables: Sequence[Table], *, record: bool) -> None:
    """Print tables, and append them to the benchmark's results file if wanted.

    Args:
        benchmark: its module, such as ``speed.solve``.
        tables: the results.
        record: whether to keep them.
    """
    for table in tables:
        print(f"\n{table.text()}")
    if not record:
        return
    RESULTS.mkdir(exist_ok=True)
    entry = Entry(commit(), date.today().isoformat(), _command(benchmark), _machine(), (*tables,))
    with (RESULTS / f"{benchmark}.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps(asdict(entry)) + "\n")


def commit(checkout: Path = ROOT) -> str:
    """Short hash of a checkout, with ``+`` if its sources have uncommitted changes."""
    short = _git(checkout, "rev-parse", "--short=7", "HEAD")
    sources = ("calibgraph", "factors", "benchmarks/*.py")
    return short + ("+" if _git(checkout, "status", "--porcelain", "--", *sources) else "")


def _git(checkout: Path, *arguments: str) -> str:
    found = subprocess.run(
        ["git", *arguments], cwd=checkout, check=True, capture_output=True, text=True
    )
    return found.stdout.strip()


def _command(benchmark: str) -> str:
    """The command that was called; absolute paths, which only this machine has, by their names."""
    words = [word for word in sys.argv[1:] if word != "--record"]
    options = [Path(word).name if word.startswith("/") else word for word in words]
    return " ".join(["python -m", f"benchmarks.{benchmark}", *options])


def _machine() -> str:
    return f"{platform.machine()}, {os.cpu_count()} cores"
