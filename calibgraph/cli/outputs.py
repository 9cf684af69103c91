"""What each command writes, and what it reads: checked before any work, in one place."""

from collections.abc import Callable, Iterator, Mapping
from functools import wraps
from pathlib import Path
from typing import Any

from calibgraph.model.result_files import MATCH, REPORT_FILE, outputs_of_result, table_mark
from calibgraph.outputs import (
    AUDIT_PAGE_MARK,
    DOT_MARK,
    PAGE_MARK,
    VIEW_MARK,
    WEIGHTS_MARK,
    WINDOW_WEIGHTS_MARK,
    Output,
    marked_yaml,
    png_mark,
    require_outside_dataset,
    require_writable,
)

Given = Mapping[str, Any]
"""The arguments and options of a command, by name."""
Outputs = Callable[[Given], list[Output]]
"""The files that a command writes with given arguments."""

TABLE_SUFFIXES, PAGE_SUFFIXES = (".parquet", ".csv"), (".html", ".htm")
WRITTEN = ("out", "rerun", "mcap", "plot", "page", "graph")
"""The options that name what a command writes."""


def named(option: str, command: str, mark: bytes | str, *suffixes: str) -> Outputs:
    """The file that an option of a command names, if it is given."""
    marks = (mark if isinstance(mark, bytes) else mark.encode(),)

    def outputs(given: Given) -> list[Output]:
        path = given[option]
        return [] if path is None else [Output(path, command, marks, suffixes)]

    return outputs


table = named("out", "match", table_mark(MATCH), *TABLE_SUFFIXES)
"""A table of correspondences; a CSV file has no place for a mark."""
plot_of_drift = named("plot", "drift", png_mark("drift"), ".png")
page_of_audit = named("page", "check", AUDIT_PAGE_MARK, *PAGE_SUFFIXES)
fleet_page = named("out", "fleet-report", PAGE_MARK, *PAGE_SUFFIXES)
weights = named("out", "weights", WEIGHTS_MARK, ".safetensors")
window_weights = named("out", "train-windows", WINDOW_WEIGHTS_MARK, ".json")
_graph = named("graph", "solve --graph", DOT_MARK, ".dot")
_rerun = named("rerun", "view", VIEW_MARK, ".rrd")
_mcap = named("mcap", "view", VIEW_MARK, ".mcap")


def result(given: Given) -> list[Output]:
    """The files of a result in the folder of ``--out``."""
    return outputs_of_result(given["out"])


def solved(given: Given) -> list[Output]:
    """The files of a result, and its graph if that is wanted."""
    return result(given) + _graph(given)


def page(given: Given) -> list[Output]:
    """The page of a report, in the folder of the result if it is not named."""
    folder = given["result"] if given["result"].is_dir() else given["result"].parent
    marks = (PAGE_MARK,)
    return [Output(given["out"] or folder / REPORT_FILE, "report", marks, PAGE_SUFFIXES)]


def recordings(given: Given) -> list[Output]:
    """A result for viewers."""
    return _rerun(given) + _mcap(given)


def fleet_model(given: Given) -> list[Output]:
    """The files of a fleet's model, in the folder of ``--out``."""
    from calibgraph.fleet.model_files import outputs_of_fleet_model

    return outputs_of_fleet_model(given["out"])


def exported(given: Given) -> list[Output]:
    """A calibration in the format of another program."""
    from calibgraph.io.formats.export import outputs_of_export

    return outputs_of_export(given["out"], given["format"])


def rig_of(command: str) -> Outputs:
    """The rig file of a command, if it is wanted."""
    return lambda given: [] if given["out"] is None else [marked_yaml(given["out"], command)]


def pictures(given: Given) -> list[Output]:
    """The guess on images."""
    found = [] if given["out"] is None else sorted(given["out"].glob("guess_*.png"))
    return [Output(path, "doctor", (png_mark("doctor"),)) for path in found]


def training(given: Given) -> list[Output]:
    """Settings beside the weights, which the library refuses to replace but with ``--resume``."""
    path = given["out"].with_suffix(".settings.yaml")
    return [] if given["resume"] else [marked_yaml(path, "train")]


def picked(given: Given) -> list[Output]:
    """The session of picking and its files, in the folder of ``--out``."""
    from calibgraph.service.pick.reference import outputs_of_pick

    return outputs_of_pick(given["out"])


def nothing(given: Given) -> list[Output]:
    """No file; or a new folder, which the library refuses if it holds data."""
    return []


def keep_files(command: Callable[..., None], outputs: Outputs) -> Callable[..., None]:
    """A command that refuses, before any work, to replace what it reads or did not write.

    Args:
        command: a function for typer. What it reads is every path among its arguments but those in
            ``WRITTEN``.
        outputs: the files that it writes with given arguments.
    """

    @wraps(command)
    def run(**given: Any) -> None:
        files, read = outputs(given), [given[name] for name in given if name not in WRITTEN]
        require_writable(files, [path for each in read for path in _files_at(each)])
        for output in files:
            require_outside_dataset(
                output.path, (path for each in read for path in _folders_at(each))
            )
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


def _folders_at(value: object) -> Iterator[Path]:
    """The folders that an argument names."""
    items = value if isinstance(value, (list, tuple)) else [value]
    named = (Path(item) for item in items if isinstance(item, (str, Path)))
    yield from (path for path in named if _exists(path) and path.is_dir())


def _exists(path: Path) -> bool:
    """Whether an argument is a path at all: a list of frames may be longer than any name."""
    try:
        return path.exists()
    except OSError:
        return False
