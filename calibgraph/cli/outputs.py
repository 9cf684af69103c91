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

TABLE_SUFFIXES = (".parquet", ".csv")
WRITTEN = ("out", "rerun", "mcap", "plot", "page")
"""The options that name what a command writes."""


def result(given: Given) -> list[Output]:
    """The files of a result in the folder of ``--out``."""
    from calibgraph.model.result_files import outputs_of_result

    return outputs_of_result(given["out"])


def table(given: Given) -> list[Output]:
    """A table of correspondences; a CSV file has no place for a mark."""
    from calibgraph.model.result_files import is_table_of_match
    from calibgraph.outputs import Output

    return [Output(given["out"], "match", is_table_of_match, TABLE_SUFFIXES)]


def page(given: Given) -> list[Output]:
    """The page of a report, in the folder of the result if it is not named."""
    from calibgraph.model.result_files import REPORT_FILE, is_report
    from calibgraph.outputs import Output

    folder = given["result"] if given["result"].is_dir() else given["result"].parent
    return [Output(given["out"] or folder / REPORT_FILE, "report", is_report, (".html", ".htm"))]


def recordings(given: Given) -> list[Output]:
    """A result for viewers."""
    from calibgraph.view.mcap_file import output_of_mcap
    from calibgraph.view.rerun_file import output_of_rerun

    makers = {"rerun": output_of_rerun, "mcap": output_of_mcap}
    return [make(given[name]) for name, make in makers.items() if given[name] is not None]


def plot_of_drift(given: Given) -> list[Output]:
    """The picture of a comparison, if it is wanted."""
    from calibgraph.audit.drift_plot import output_of_drift_plot

    return [] if given["plot"] is None else [output_of_drift_plot(given["plot"])]


def page_of_audit(given: Given) -> list[Output]:
    """The page of an audit, if it is wanted."""
    if given["page"] is None:
        return []
    from calibgraph.audit.page import output_of_audit_report

    return [output_of_audit_report(given["page"])]


def fleet_page(given: Given) -> list[Output]:
    """The page of a fleet."""
    from calibgraph.model.result_files import is_report
    from calibgraph.outputs import Output

    return [Output(given["out"], "fleet-report", is_report, (".html", ".htm"))]


def fleet_model(given: Given) -> list[Output]:
    """What a fleet knows, in the folder of ``--out``."""
    from calibgraph.fleet.model_files import outputs_of_fleet_model

    return outputs_of_fleet_model(given["out"])


def guess(given: Given) -> list[Output]:
    """A displaced rig."""
    return [_marked_yaml(given["out"], "perturb")]


def exported(given: Given) -> list[Output]:
    """A calibration in the format of another program."""
    from calibgraph.io.formats.export import outputs_of_export

    return outputs_of_export(given["out"], given["format"])


def imported(given: Given) -> list[Output]:
    """A rig from files of others."""
    return [_marked_yaml(given["out"], "import")]


def rig_guess(given: Given) -> list[Output]:
    """A rig to begin with."""
    return [_marked_yaml(given["out"], "guess")]


def rig_of_bag(given: Given) -> list[Output]:
    """A rig from a bag, if it is wanted."""
    return [] if given["out"] is None else [_marked_yaml(given["out"], "bag")]


def pictures(given: Given) -> list[Output]:
    """The guess on images."""
    from calibgraph.outputs import Output, has_png_mark

    folder = given["out"]
    found = [] if folder is None else sorted(folder.glob("guess_*.png"))
    return [Output(path, "doctor", has_png_mark("doctor")) for path in found]


def weights(given: Given) -> list[Output]:
    """Converted weights, if they are wanted."""
    from calibgraph.outputs import Output

    def is_ours(path: Path) -> bool:
        from calibgraph.matching.cmrnext import is_converted

        return is_converted(path)

    out = given["out"]
    return [] if out is None else [Output(out, "weights", is_ours, (".safetensors",))]


def training(given: Given) -> list[Output]:
    """Settings beside the weights, which the library refuses to replace but with ``--resume``."""
    path = given["out"].with_suffix(".settings.yaml")
    return [] if given["resume"] else [_marked_yaml(path, "train")]


def picked(given: Given) -> list[Output]:
    """The session of picking and what it gives, in the folder of ``--out``."""
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
        from calibgraph.outputs import require_apart, require_free

        files, read = outputs(given), [given[name] for name in given if name not in WRITTEN]
        require_free(files, [path for each in read for path in _files_at(each)])
        for output in files:
            require_apart(output.path, (path for each in read for path in _folders_at(each)))
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


def _marked_yaml(path: Path, command: str) -> Output:
    from calibgraph.outputs import Output, has_yaml_mark

    return Output(path, command, has_yaml_mark(command), (".yaml", ".yml"))
