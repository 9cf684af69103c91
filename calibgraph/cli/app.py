"""The command line's frame: its commands, one-line errors, exit codes.

Human output goes to stderr, machine output (``--json``) to stdout. Exit codes: 0 done (PASS or
WARN), 1 the calibration FAILed (its files are written and marked FAIL), 2 bad input (one line),
130 interrupted.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Annotated

import typer

from calibgraph.cli.benchmark import bench, tune
from calibgraph.cli.calibrate import calibrate, match, solve
from calibgraph.cli.inspect import evaluate, perturb, report
from calibgraph.cli.learned import train, weights
from calibgraph.cli.simulate import simulate
from calibgraph.cli.track import track

_INTERRUPTED = 130
_WEIGHTS_SUFFIXES = (".tar", ".pt", ".pth", ".safetensors")
_UsageError: type[Exception] = typer.BadParameter.__base__ or Exception

app = typer.Typer(
    help="Calibrate all cameras around a LiDAR at once, from ordinary driving data.\n\n"
    "T_a_b maps coordinates in b to coordinates in a: p_camera = T_camera_lidar * p_lidar. "
    "A RIG, ESTIMATE or REFERENCE is a rig file, a result (file or folder), a dataset folder "
    "(its rig.yaml) or a KITTI odometry sequence folder.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"calibgraph {version('calibgraph')}")
        raise typer.Exit


@app.callback()
def _options(
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Options before the command; ``--debug`` is read by :func:`main`."""


for _command in (
    calibrate, match, solve, report, evaluate, perturb, simulate, weights, train, tune, track
):  # fmt: skip
    app.command()(_command)
app.add_typer(bench, name="bench")


def main() -> None:
    """Run the command line; errors in the data become one line on stderr and exit code 2."""
    from calibgraph.errors import CalibrationError

    sys.argv[1:] = list(_repeat_weights_option(sys.argv[1:]))
    try:
        code = app(standalone_mode=False) or 0
        if code == _INTERRUPTED:  # what typer returns after Ctrl-C
            raise KeyboardInterrupt
        sys.exit(code)
    except (CalibrationError, OSError, _UsageError) as error:
        if "--debug" in sys.argv:
            raise
        if str(error) or not isinstance(error, _UsageError):  # else the help has been printed
            print(f"calibgraph: {_one_line(error)}", file=sys.stderr)
        sys.exit(2)
    except (typer.Abort, KeyboardInterrupt):
        print("calibgraph: interrupted", file=sys.stderr)
        sys.exit(_INTERRUPTED)


def _repeat_weights_option(arguments: list[str]) -> Iterator[str]:
    """Expand ``--weights a.tar b.tar`` to ``--weights a.tar --weights b.tar``."""
    in_list, previous = False, ""
    for argument in arguments:
        if previous == "--weights" or argument.startswith("--weights="):
            in_list = True
        elif in_list and argument.lower().endswith(_WEIGHTS_SUFFIXES):
            yield "--weights"
        else:
            in_list = False
        yield argument
        previous = argument


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    text = error.format_message() if hasattr(error, "format_message") else str(error)
    more = "; see calibgraph --help" if isinstance(error, _UsageError) else ""
    return " ".join(text.split()).removesuffix(".") + more
