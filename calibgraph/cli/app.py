"""The command line's frame: its commands, one-line errors, exit codes.

Human output goes to stderr, machine output (``--json``) to stdout. Exit codes: 0 done (PASS or
WARN), 1 the calibration FAILed (its files are written and marked FAIL), is WRONG (``check``) or has
CHANGED (``drift``), 2 bad input (one line), 3 the data cannot tell (both), 130 interrupted.
"""

from __future__ import annotations

import atexit
import gc
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from shlex import join
from typing import Any, TextIO

import typer

from calibgraph.cli.calibrate import calibrate, match, solve, track
from calibgraph.cli.inspect import check, doctor, drift, evaluate, export, perturb, report, simulate
from calibgraph.cli.rig import rig
from calibgraph.cli.serve import fleet, pick, serve
from calibgraph.errors import CalibrationError, printable
from calibgraph.stdout import discard

_INTERRUPTED = 130
_COLLECT_AFTER = 100_000, 20, 20
"""Objects and passes between collections. With Python's own numbers, a fifth of the time in which
kernels are compiled goes into searches of objects that all live."""
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1"}
"""BLAS and OpenCV get one thread each: calibgraph's own threads use all cores, and idle threads of
these libraries spin (0.3 s of processor time while BLAS starts)."""
_UsageError: type[Exception] = typer.BadParameter.__base__ or Exception

app = typer.Typer(
    help="Calibrate all cameras around a LiDAR at once, from ordinary driving data.\n\n"
    "T_a_b maps coordinates in b to coordinates in a: p_camera = T_camera_lidar * p_lidar. "
    "A RIG, ESTIMATE or REFERENCE is a rig file, a result (file or folder), a dataset folder "
    "(its rig.yaml), a KITTI odometry sequence folder, a nuScenes folder or a ROS bag.",
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
    debug: bool = typer.Option(False, "--debug", help="Show tracebacks."),
    version: bool = typer.Option(
        False, "--version", callback=_print_version, is_eager=True, help="Print the version."
    ),
) -> None:
    """Options before the command; ``--debug`` is read by :func:`main`."""


COMMANDS: tuple[Callable[..., None], ...] = (
    calibrate, check, drift, rig, doctor, match, solve, report, evaluate, export, track, pick,
    simulate, perturb, fleet, serve,
)  # fmt: skip
"""In the order of the help."""
for _command in COMMANDS:
    _help = "\n\n".join(" ".join(text.split()) for text in (_command.__doc__ or "").split("\n\n"))
    app.command(help=_help)(_command)


def main() -> None:
    """Run the command line; errors in the data become one line on stderr and exit code 2."""
    os.environ.update(_ONE_THREAD | os.environ)
    gc.set_threshold(*_COLLECT_AFTER)
    atexit.register(gc.freeze)  # at its end Python would look for garbage in all objects: 0.3 s
    try:
        _require_utf8(sys.argv[1:])
        code = _run_app()
        if code == _INTERRUPTED:  # what typer returns after Ctrl-C
            raise KeyboardInterrupt
        sys.exit(code)
    except (CalibrationError, OSError, _UsageError) as error:
        if "--debug" in sys.argv:
            raise
        if str(error) or not isinstance(error, _UsageError):  # else the help has been printed
            _print_error(_one_line(error))
        sys.exit(2)
    except (typer.Abort, KeyboardInterrupt):
        _print_error("interrupted")
        sys.exit(_INTERRUPTED)
    except Exception as error:  # not the exit code 1 of Python: that is a FAIL
        if "--debug" in sys.argv:
            raise
        _print_error(_crash(error))
        sys.exit(2)
    finally:
        _flush(sys.stdout)


def _require_utf8(arguments: list[str]) -> None:
    """Check the arguments: results hold the paths of their input, as text."""
    for argument in arguments:
        try:
            argument.encode()
        except UnicodeEncodeError as error:
            message = f"{argument}: is not UTF-8; rename the file or folder"
            raise CalibrationError(message) from error


@cache
def _parser() -> Any:
    """The command line, once per process."""
    return typer.main.get_command(app)


def _run_app() -> int:
    """The exit code of the command."""
    try:
        return _parser()(standalone_mode=False, prog_name="calibgraph") or 0
    except SystemExit:  # of typer and rich when the reader of the help has gone: 1, our FAIL
        return 0


def _print_error(text: str) -> None:
    with suppress(BrokenPipeError):
        print(f"calibgraph: {text}", file=sys.stderr)
    _flush(sys.stderr)


def _flush(stream: TextIO | None) -> None:
    """Write what is left, or discard it: Python would try again at its exit, and report it."""
    if stream is None:  # closed
        return
    try:
        stream.flush()
    except OSError:
        discard(stream)


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename:
        return printable(f"{error.filename}: {error.strerror}")
    text = error.format_message() if hasattr(error, "format_message") else str(error)
    return printable(" ".join(text.split())).removesuffix(".") + _help_hint(error)


def _crash(error: Exception) -> str:
    """An error that no one foresaw, in one line."""
    if isinstance(error, MemoryError):
        why = f" ({error})" if str(error) else ""
        return f"not enough memory{why}; give fewer frames, or smaller files"
    kind = f"{type(error).__name__}: {CalibrationError(str(error))}"
    again = join(["calibgraph", "--debug", *sys.argv[1:]])
    return f"internal error ({kind}); please report it with the output of {again}"


def _help_hint(error: Exception) -> str:
    """Where the options are described: in the help of the command that was called, if one was."""
    if not isinstance(error, _UsageError):
        return ""
    context = getattr(error, "ctx", None)
    names = context.command_path.split()[1:] if context is not None else []
    return "; see " + " ".join(["calibgraph", *names, "--help"])
