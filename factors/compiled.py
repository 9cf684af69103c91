"""The decorator of all kernels: compiled by numba on first use, and kept for later processes.

The machine code is kept in ``NUMBA_CACHE_DIR`` if that is set, else in the user's cache folder,
else beside the source. Who can write it can run code as the user, since numba reads pickles. So a
folder is used only if it is the user's alone. Where there is none, kernels are compiled in memory,
and one line on standard error (by ``logging``) reports it once.

numba compares the source file of a kernel alone, and not what the file imports. So the cache is one
of this file and of the files with kernels that it imports, of the options below, and of the
versions of Python, numpy and numba: a change of any of them begins another, a change elsewhere
keeps it, and environments with other versions do not overwrite each other's code while it is in
use. A kernel uses kernels and constants of these files alone. It may enclose numbers, but no other
kernel: numba would not find its code again.
"""

import errno
import hashlib
import logging
import os
import re
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from itertools import chain
from pathlib import Path
from threading import Lock
from typing import Any

import numba
import numpy as np
import platformdirs

_UNUSED_S = 7 * 86400.0  # a folder of code that no process has used for so long is removed
_COMMON: Any = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
_log = logging.getLogger(__name__)
_config: Any = numba.config  # its attributes are made when numba is imported

_decorating = Lock()  # threads make kernels too: one at a time sets numba's folder
os.register_at_fork(  # no child is made while another thread holds it
    before=_decorating.acquire,
    after_in_parent=_decorating.release,
    after_in_child=_decorating.release,
)


def compiled(*, part: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function without Python objects (``numba.njit``) when it is first called.

    It runs without Python's lock, and divides as numpy does.

    Args:
        part: of other kernels: it compiles faster, and a call from Python would end the process.
        options: of ``numba.njit``, but for ``cache``.
    """
    if part:
        options["no_cpython_wrapper"] = True

    def decorate(function: Callable[..., Any]) -> Any:
        function.__qualname__ = _name(function, options)
        with _decorating:
            before = _config.CACHE_DIR
            folder = _folder(function.__module__)
            _config.CACHE_DIR = str(folder or before)  # numba reads it where it decorates
            try:
                jit = numba.njit(cache=folder is not None, **_COMMON, **options)
                return jit(function)
            finally:
                _config.CACHE_DIR = before

    return decorate


def _name(function: Callable[..., Any], options: Mapping[str, Any]) -> str:
    """A name for each set of options and of values that a kernel encloses.

    numba keeps the code of one name in numbered files, and two processes that make kernels of one
    name at a time may take each other's number: a lens would be projected by the code of another.
    """
    enclosed = [cell.cell_contents for cell in function.__closure__ or ()]
    values = [getattr(value, "__qualname__", repr(value)) for value in enclosed]
    in_order = {k: sorted(v) if isinstance(v, (set, frozenset)) else v for k, v in options.items()}
    known = [*values, *(f"{option}={value}" for option, value in sorted(in_order.items()))]
    digest = hashlib.sha256(" ".join(known).encode()).hexdigest()[:8] if known else ""
    return "_".join(filter(None, (function.__qualname__, digest)))


@cache
def _files(module: str) -> tuple[Path, ...]:
    """The file of a module, and the files with kernels that it imports, and that these do."""
    name = getattr(sys.modules.get(module), "__file__", None)
    source = Path(name).read_text("utf-8") if name else ""
    if not re.search(r"^\s*@compiled\b", source, re.MULTILINE):
        return ()
    others = re.findall(r"^from (\S+) import", source, re.MULTILINE)
    return tuple(sorted({Path(str(name)), *chain.from_iterable(map(_files, others))}))


@cache
def _folder(module: str) -> Path | None:
    """Where the code of the kernels of a module is kept; None if there is no safe place."""
    versions = f"{numba.__version__} {np.__version__} {sys.version} {sorted(_COMMON.items())}"
    digest = hashlib.sha256(versions.encode())
    for file in _files(module):
        digest.update(file.read_bytes())
    name, chosen = f"{module}-{digest.hexdigest()[:16]}", _config.CACHE_DIR
    user, beside = platformdirs.user_cache_path("calibgraph"), Path(__file__).parent / "__pycache__"
    reasons = []
    for place in [Path(chosen)] if chosen else [user, beside]:
        try:
            return _prepare(place.resolve() / name)
        except OSError as error:
            reasons.append(f"{error.filename}: {error.strerror}")
    _report_once(reasons[0])
    return None


def _prepare(folder: Path) -> Path:
    """Make a folder that the user alone can write, and remove those beside it that nobody uses.

    Raises:
        OSError: if that is not possible.
    """
    is_new = not folder.exists()
    for part in reversed((folder, *folder.parents)):
        if not part.exists():
            part.mkdir(mode=0o700, exist_ok=True)
        _require_own(part, above=part != folder)
    for part in folder.rglob("*"):
        with suppress(FileNotFoundError):  # what another process writes is renamed
            _require_own(part)
    if is_new:
        kind, oldest = folder.name.rsplit("-", 1)[0], time.time() - _UNUSED_S
        for other in folder.parent.glob(f"{kind}-*"):
            if other.stat().st_mtime < oldest:
                shutil.rmtree(other, ignore_errors=True)
    tempfile.TemporaryFile(dir=folder).close()  # its time is now that of its last use
    return folder


def _require_own(path: Path, *, above: bool = False) -> None:
    """Refuse what others own or may write. A folder above may be root's, and shared as /tmp is.

    A group with the number of the user is taken for the user's own.
    """
    user, found = os.geteuid(), path.lstat()
    by_group = 0 if found.st_gid in (user, 0) else stat.S_IWGRP
    if found.st_uid != user and not (above and found.st_uid == 0):
        raise PermissionError(errno.EPERM, "belongs to another user", str(path))
    if found.st_mode & (stat.S_IWOTH | by_group) and not (above and found.st_mode & stat.S_ISVTX):
        raise PermissionError(errno.EPERM, "others may write it", str(path))


@cache
def _report_once(why: str) -> None:
    if _report_once.cache_info().currsize == 0:
        _log.warning(
            "calibgraph: compiled code is not kept (%s), so every start compiles it anew; "
            "set NUMBA_CACHE_DIR to a folder that you alone can write",
            why,
        )
