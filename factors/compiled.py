"""The decorator of all kernels: compiled by numba on first use, and kept for later processes.

The machine code is kept by numba, below ``NUMBA_CACHE_DIR`` if that is set, else below the user's
cache folder, else beside the source. Where nothing can be written, kernels are compiled in memory,
and one line on standard error (by ``logging``) reports it once.

numba compares the source file of a kernel alone, and no options. So the code lies in a folder of
its own for each version of the files with kernels, beside the kernel's and in ``factors``, and each
choice of options. Kernels use kernels and constants of these alone; a test holds them to it.
"""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any

import numba
import platformdirs

_HERE = Path(__file__).parent
_log = logging.getLogger(__name__)

_all_cores = Lock()
os.register_at_fork(  # no child is made while another thread holds it
    before=_all_cores.acquire,
    after_in_parent=_all_cores.release,
    after_in_child=_all_cores.release,
)


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function without Python objects (``numba.njit``) when it is first called.

    It runs without Python's lock, and divides as numpy does.

    Args:
        options: of ``numba.njit``, but for ``cache``.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        folder = _folder()
        sources = Path(function.__code__.co_filename).parent
        with _kept_in(folder / _fingerprint(sources, options) if folder else None):
            kept = folder is not None
            return numba.njit(nogil=True, error_model="numpy", cache=kept, **options)(function)

    return decorate


def one_at_a_time(kernel: Any) -> Callable[..., Any]:
    """A kernel with ``parallel=True``, for threads: a call waits until such calls of others end.

    Each takes all cores, and without OpenMP or TBB numba ends the process if two run at once.
    """

    def run(*arguments: Any) -> Any:
        with _all_cores:
            return kernel(*arguments)

    return run


@contextmanager
def _kept_in(folder: Path | None) -> Iterator[None]:
    """Have numba choose this folder for the kernels that are defined meanwhile."""
    config: Any = numba.config  # numba reads NUMBA_CACHE_DIR into it
    before, config.CACHE_DIR = config.CACHE_DIR, str(folder or config.CACHE_DIR)
    try:
        yield
    finally:
        config.CACHE_DIR = before


def _fingerprint(sources: Path, options: dict[str, Any]) -> str:
    """The name of the folder for kernels with these options, from this folder of sources."""
    ordered = sorted((name, sorted(value) if isinstance(value, set) else value)
                     for name, value in options.items())  # fmt: skip
    return hashlib.sha256(f"{_digest(sources)} {ordered}".encode()).hexdigest()[:16]


@cache
def _digest(sources: Path) -> str:
    """Of what kernels in a folder may use: the files of this package, and those with kernels."""
    digest = hashlib.sha256()
    for file in [*sorted(_HERE.glob("*.py")), *sorted(sources.glob("*.py"))]:
        content = file.read_bytes()
        if file.parent == _HERE or b"@compiled(" in content:
            digest.update(content)
    return digest.hexdigest()


@cache
def _folder() -> Path | None:
    """Where kernels are kept: the first place that can be written; reported, if there is none."""
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    places = platformdirs.user_cache_path("calibgraph"), _HERE / "__pycache__"
    why: OSError | None = None
    for place in (Path(chosen),) if chosen else places:
        try:
            place.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=place).close()
            return place
        except OSError as error:
            why = why or error
    _log.warning(
        "calibgraph: compiled code cannot be kept (%s), so every start compiles it anew; "
        "set NUMBA_CACHE_DIR to a folder that can be written",
        f"{places[0] if why is None else why.filename}: {why and why.strerror}",
    )
    return None
