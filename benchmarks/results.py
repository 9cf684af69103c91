"""Write benchmarks/notes/results.md from the results files: the newest run of every command.

python -m benchmarks.results
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from benchmarks.tables import RESULTS, Entry

PAGE = Path(__file__).parent / "notes" / "results.md"

_HEAD = """# Results of the benchmarks

Written by `python -m benchmarks.results` from `benchmarks/results`, to which every benchmark
appends with `--record`. Each table names the commit and the command it comes from (`+`: with
uncommitted changes). What each benchmark measures: `benchmarks/README.md`."""


def page() -> str:
    """The text of benchmarks/notes/results.md."""
    sections = (section for path in sorted(RESULTS.glob("*.jsonl")) for section in _sections(path))
    return "\n\n".join([_HEAD, *sections]) + "\n"


def _sections(path: Path) -> Iterator[str]:
    """The newest run of every command of one benchmark."""
    entries = [Entry.from_json(line) for line in path.read_text("utf-8").splitlines()]
    newest = {entry.command: entry for entry in entries}
    yield f"## {path.stem}"
    for entry in newest.values():
        yield f"`{entry.command}`, commit {entry.commit}, {entry.date}, {entry.machine}"
        yield from (table.markdown() for table in entry.tables)


if __name__ == "__main__":
    PAGE.write_text(page(), "utf-8")
