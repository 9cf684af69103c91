"""What each command writes, and what it reads: checked before any work, in one place."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from calibgraph.outputs import Output

Given = Mapping[str, Any]
"""The arguments and options of a command, by name."""

TABLE_SUFFIXES, PAGE_SUFFIXES = (".parquet", ".csv"), (".html", ".htm")
WRITTEN = ("out", "rerun", "mcap", "plot", "page")
"""The options that name what a command writes."""


def result(given: Given) -> list[Output]:
    """The files of a result in the folder of ``--out``."""
    from calibgraph.model.result_files import outputs_of_result

    return outputs_of_result(given["out"])


def table(given: Given) -> list[Output]:
    """A table of correspondences; a CSV file has no place for a mark."""
    from calibgraph.model.result_files import MATCH, table_mark
    from calibgraph.outputs import Output

    return [Output(given["out"], "match", (table_mark(MATCH),), TABLE_SUFFIXES)]


def page(given: Given) -> list[Output]:
    """The page of a report, in the folder of the result if it is not named."""
    from calibgraph.model.result_files import PAGE_MARK, REPORT_FILE
    from calibgraph.outputs import Output

    folder = given["result"] if given["result"].is_dir() else given["result"].parent
    return [Output(given["out"] or folder / REPORT_FILE, "report", (PAGE_MARK,), PAGE_SUFFIXES)]


def recordings(given: Given) -> list[Output]:
    """A result for viewers."""
    from calibgraph.view.mcap_file import PROFILE
    from calibgraph.view.rerun_file import APPLICATION

    rerun = _if_wanted(given["rerun"], "view", APPLICATION.encode(), (".rrd",))
    return rerun + _if_wanted(given["mcap"], "view", PROFILE.encode(), (".mcap",))


def plot_of_drift(given: Given) -> list[Output]:
    """The picture of a comparison, if it is wanted."""
    from calibgraph.outputs import png_mark

    return _if_wanted(given["plot"], "drift", png_mark("drift"), (".png",))


def page_of_audit(given: Given) -> list[Output]:
    """The page of an audit, if it is wanted."""
    from calibgraph.audit.page import MARK

    return _if_wanted(given["page"], "check", MARK, PAGE_SUFFIXES)


def fleet_page(given: Given) -> list[Output]:
    """The page of a fleet."""
    from calibgraph.model.result_files import PAGE_MARK

    return _if_wanted(given["out"], "fleet-report", PAGE_MARK, PAGE_SUFFIXES)


def fleet_model(given: Given) -> list[Output]:
    """The files of a fleet's model, in the folder of ``--out``."""
    from calibgraph.fleet.model_files import outputs_of_fleet_model

    return outputs_of_fleet_model(given["out"])


def exported(given: Given) -> list[Output]:
    """A calibration in the format of another program."""
    from calibgraph.io.formats.export import outputs_of_export

    return outputs_of_export(given["out"], given["format"])


def rig_of(command: str) -> Callable[[Given], list[Output]]:
    """The rig file of a command, if it is wanted."""

    def outputs(given: Given) -> list[Output]:
        from calibgraph.outputs import marked_yaml

        return [] if given["out"] is None else [marked_yaml(given["out"], command)]

    return outputs


def pictures(given: Given) -> list[Output]:
    """The guess on images."""
    from calibgraph.outputs import Output, png_mark

    folder = given["out"]
    found = [] if folder is None else sorted(folder.glob("guess_*.png"))
    return [Output(path, "doctor", (png_mark("doctor"),)) for path in found]


def weights(given: Given) -> list[Output]:
    """Converted weights, if they are wanted."""
    from calibgraph.matching.cmrnext import CONVERTED

    return _if_wanted(given["out"], "weights", CONVERTED.encode(), (".safetensors",))


def training(given: Given) -> list[Output]:
    """Settings beside the weights, which the library refuses to replace but with ``--resume``."""
    from calibgraph.outputs import marked_yaml

    path = given["out"].with_suffix(".settings.yaml")
    return [] if given["resume"] else [marked_yaml(path, "train")]


def picked(given: Given) -> list[Output]:
    """The session of picking and its files, in the folder of ``--out``."""
    from calibgraph.service.pick.reference import outputs_of_pick

    return outputs_of_pick(given["out"])


def nothing(given: Given) -> list[Output]:
    """No file; or a new folder, which the library refuses if it holds data."""
    return []


def keep_files(
    command: Callable[..., None], outputs: Callable[[Given], list[Output]]
) -> Callable[..., None]:
    """A command that refuses, before any work, to replace what it reads or did not write.

    Args:
        command: a function for typer. What it reads is every path among its arguments but those in
            ``WRITTEN``.
        outputs: the files that it writes with given arguments.
    """

    @wraps(command)
    def run(**given: Any) -> None:
        from calibgraph.outputs import require_outside_dataset, require_writable

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


def _if_wanted(
    path: Path | None, command: str, mark: bytes, suffixes: tuple[str, ...]
) -> list[Output]:
    from calibgraph.outputs import Output

    return [] if path is None else [Output(path, command, (mark,), suffixes)]
