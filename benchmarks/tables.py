"""Tables of results: printed as Markdown, for the notes, with their commit and command."""

import argparse
import os
import platform
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import date
from pathlib import Path

ROOT = Path(__file__).parents[1]


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
        """A table in Markdown whose columns are aligned: the first to the left, numbers right."""
        lines = [self.columns, ("---",) * len(self.columns), *self.rows]
        widths = [max(len(line[i]) for line in lines) for i in range(len(self.columns))]
        cells = (
            [line[0].ljust(widths[0])]
            + [cell.rjust(width) for cell, width in zip(line[1:], widths[1:], strict=True)]
            for line in lines
        )
        return "\n".join([f"{self.title}:", "", *(f"| {' | '.join(row)} |" for row in cells)])


def parser_of(description: str | None) -> argparse.ArgumentParser:
    """The parser of a benchmark's options; its help is the module's text."""
    return argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def publish(tables: Iterable[Table]) -> None:
    """Print tables below the commit, the date, the machine and the command."""
    main = sys.modules["__main__"].__spec__
    name = main.name.removesuffix(".__main__") if main else sys.argv[0]
    command = " ".join(["python -m", name, *sys.argv[1:]])
    print(
        f"\n`{command}`, {commit()}, {date.today()}, {platform.machine()}, {os.cpu_count()} cores"
    )
    for table in tables:
        print(f"\n{table.text()}")


def commit(checkout: Path = ROOT) -> str:
    """Short hash of a checkout, with ``+`` if its sources have uncommitted changes, or its name."""
    if not (checkout / ".git").exists():
        return checkout.name
    short = _git(checkout, "rev-parse", "--short=7", "HEAD")
    sources = ("calibgraph", "factors", "benchmarks/*.py")
    return short + ("+" if _git(checkout, "status", "--porcelain", "--", *sources) else "")


def _git(checkout: Path, *arguments: str) -> str:
    found = subprocess.run(
        ["git", *arguments], cwd=checkout, check=True, capture_output=True, text=True
    )
    return found.stdout.strip()
