"""What each command writes, and what it reads: checked before any work, in one place."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any, get_type_hints

from calibgraph.model.result_files import MATCH, REPORT_FILE, outputs_of_result, table_mark
from calibgraph.outputs import (
    AUDIT_PAGE_MARK,
    DOT_MARK,
    PAGE_MARK,
    VIEW_MARK,
    WEIGHTS_MARK,
    Output,
    marked_yaml,
    png_mark,
    require_writable,
)

Given = Mapping[str, Any]
"""The arguments and options of a command, by name."""
TABLE_SUFFIXES, PAGE_SUFFIXES = (".parquet", ".csv"), (".html", ".htm")


@dataclass(frozen=True)
class Writes:
    """In the annotation of an option: the files that the command writes by its value."""

    outputs: Callable[[Any, Given], list[Output]]


def _named(command: str, mark: bytes | str, *suffixes: str) -> Writes:
    """The file that the option names, if it is given."""
    marks = (mark if isinstance(mark, bytes) else mark.encode(),)
    return Writes(lambda path, _: [] if path is None else [Output(path, command, marks, suffixes)])


def rig_of(command: str) -> Writes:
    """The rig file of a command, if it is wanted."""
    return Writes(lambda path, _: [] if path is None else [marked_yaml(path, command)])


TABLE = _named("match", table_mark(MATCH), *TABLE_SUFFIXES)
"""A table of correspondences; a CSV file has no place for a mark."""
PAGE_OF_AUDIT = _named("check", AUDIT_PAGE_MARK, *PAGE_SUFFIXES)
WEIGHTS = _named("weights", WEIGHTS_MARK, ".safetensors")
GRAPH = _named("solve --graph", DOT_MARK, ".dot")
RERUN, MCAP = (_named("view", VIEW_MARK, suffix) for suffix in (".rrd", ".mcap"))
RESULT = Writes(lambda folder, _: outputs_of_result(folder))


def _page(path: Path | None, given: Given) -> list[Output]:
    """The page of a report, in the folder of the result if it is not named."""
    folder = given["result"] if given["result"].is_dir() else given["result"].parent
    return [Output(path or folder / REPORT_FILE, "report", (PAGE_MARK,), PAGE_SUFFIXES)]


def _exported(path: Path, given: Given) -> list[Output]:
    from calibgraph.io.formats.export import outputs_of_export

    return outputs_of_export(path, given["format"])


def _pictures(folder: Path | None, _: Given) -> list[Output]:
    """The guess on images."""
    found = [] if folder is None else sorted(folder.glob("guess_*.png"))
    return [Output(path, "doctor", (png_mark("doctor"),)) for path in found]


def _picked(folder: Path, _: Given) -> list[Output]:
    from calibgraph.pick.workspace import outputs_of_pick

    return outputs_of_pick(folder)


PAGE, EXPORTED = Writes(_page), Writes(_exported)
PICTURES, PICKED = Writes(_pictures), Writes(_picked)


def writes_of(command: Callable[..., None]) -> dict[str, Writes]:
    """By the name of an option, what it makes the command write."""
    return {
        name: each
        for name, hint in get_type_hints(command, include_extras=True).items()
        for each in getattr(hint, "__metadata__", ())
        if isinstance(each, Writes)
    }


def keep_files(command: Callable[..., None]) -> Callable[..., None]:
    """A command that refuses, before any work, to replace what it reads or did not write.

    What it reads is every path among its arguments but those that name what it writes.
    """
    writes = writes_of(command)

    @wraps(command)
    def run(**given: Any) -> None:
        files = [file for name, each in writes.items() for file in each.outputs(given[name], given)]
        read = [value for name, value in given.items() if files and name not in writes]
        require_writable(files, [path for each in read for path in _files_at(each)])
        command(**given)

    return run


def _files_at(value: object) -> Iterator[Path]:
    """The files that an argument names: itself, or in a folder the rig's file and tables."""
    from calibgraph.io.rigs import find_rig_file

    items = value if isinstance(value, (list, tuple)) else [value]
    named = [Path(item) for item in items if isinstance(item, (str, Path))]
    texts = (item.partition("=") for item in items if isinstance(item, str))
    named += [Path(file) for _, equals, file in texts if equals]  # NAME=FILE
    for path in filter(_exists, named):
        rig = find_rig_file(path)
        if rig is not None:
            yield rig
        else:
            yield from (file for suffix in TABLE_SUFFIXES for file in path.glob(f"*{suffix}"))


def _exists(path: Path) -> bool:
    """Whether an argument is a path at all: a list of frames may be longer than any name."""
    try:
        return path.exists()
    except OSError:
        return False
