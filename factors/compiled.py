"""The decorator of all kernels: compiled by numba on first use, and kept for later processes.

The machine code is kept in ``NUMBA_CACHE_DIR`` if that is set, else in the user's cache folder,
else beside the source. Where nothing can be written, kernels are compiled in memory, and one line
on standard error (by ``logging``) reports it once.

numba's own cache is not used. It compares the source file of a kernel alone: not the kernels and
constants that the file imports, nor the options, so that a kernel with and one without threads were
taken for each other. Here the name of a file holds the fingerprint of all of these.
"""

import hashlib
import inspect
import logging
import math
import os
import pickle
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from threading import Lock
from types import BuiltinFunctionType, CodeType
from typing import Any

import numba
import numpy as np
import platformdirs
from numba.core.caching import _Cache
from numba.core.compiler import CompileResult
from numba.core.dispatcher import Dispatcher
from numba.core.extending import _Intrinsic
from numba.core.serialize import dumps

_MODULES = (np, math)  # whose functions kernels use by attribute: all others must be named
_SUFFIX = ".kernel"
_DIGEST_BYTES = hashlib.sha256().digest_size
_VERSIONS_KEPT = 4  # of one kernel, for checkouts side by side; each takes up to 0.2 MB
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
        kernel = numba.njit(nogil=True, error_model="numpy", **options)(function)
        if isinstance(kernel, Dispatcher):  # with NUMBA_DISABLE_JIT it is the function
            kernel._cache = _KernelCache(kernel)  # type: ignore[attr-defined]
        return kernel

    return decorate


def one_at_a_time(kernel: Any) -> Callable[..., Any]:
    """A kernel with ``parallel=True``, for threads: a call waits until such calls of others end.

    Each takes all cores, and without OpenMP or TBB numba ends the process if two run at once.
    """

    def run(*arguments: Any) -> Any:
        with _all_cores:
            return kernel(*arguments)

    return run


def fingerprint(kernel: Any) -> str:
    """Digest of all that the machine code of a kernel is made from, its callees included.

    Raises:
        TypeError: if it uses a global that cannot be compared.
    """
    digest = hashlib.sha256()
    for part in _parts(kernel, set()):
        digest.update(part.encode() + b"\0")
    return digest.hexdigest()


def _parts(kernel: Any, seen: set[str]) -> Iterator[str]:
    function = kernel.py_func
    name = f"{function.__module__}.{function.__qualname__} {_text(kernel.targetoptions)}"
    if name in seen:
        return
    seen.add(name)
    yield name
    for code in _codes(function.__code__):
        yield f"{code.co_code.hex()} {_text(code.co_consts)} {code.co_varnames}"
        for used in code.co_names:
            value = function.__globals__.get(used)
            if isinstance(value, Dispatcher):
                yield from _parts(value, seen)
            elif isinstance(value, _Intrinsic):
                yield inspect.getsource(sys.modules[value.__module__])
            else:
                yield f"{used} {_text(value)}"


def _codes(code: CodeType) -> Iterator[CodeType]:
    """The code of a function, and of the comprehensions in it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _text(value: Any) -> str:
    """A constant as text, the same in every process."""
    if isinstance(value, (dict, set, frozenset)):
        value = sorted(value.items() if isinstance(value, dict) else value)
    if isinstance(value, (tuple, list)):
        return f"({', '.join(map(_text, value))})"
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape} {value.tobytes().hex()}"
    if value is None or isinstance(value, (bool, int, float, str, np.generic)):
        return repr(value)
    if isinstance(value, (type, BuiltinFunctionType)) or value in (*_MODULES, numba.prange):
        return str(value.__name__)
    if isinstance(value, CodeType):
        return value.co_name
    raise TypeError(f"a kernel uses {value!r}, which is not compared; give it as an argument")


class _KernelCache(_Cache):
    """The files of one kernel, for numba: one per signature, processor and fingerprint."""

    def __init__(self, kernel: Any) -> None:
        self._kernel = kernel
        self._enabled = True

    @property
    def cache_path(self) -> str:
        """The folder."""
        return str(_folder())

    def load_overload(self, signature: Any, target: Any) -> Any:
        """The code for a signature, None if it is not kept or damaged."""
        target.refresh()
        path = self._path(signature, target.codegen())
        try:
            digest, content = _split(path.read_bytes())
        except OSError:
            return None
        if not self._enabled or hashlib.sha256(content).digest() != digest:
            return None
        return CompileResult._rebuild(target, *pickle.loads(content))  # type: ignore[no-untyped-call]

    def save_overload(self, signature: Any, code: Any) -> None:
        """Keep the code for a signature; where that is impossible, it stays in memory."""
        if not self._enabled or code.library.has_dynamic_globals or code.lifted:
            return
        content = dumps(code._reduce())  # type: ignore[no-untyped-call]
        path = self._path(signature, code.codegen)
        try:
            _write(path, hashlib.sha256(content).digest() + content)
        except OSError as error:
            _report_once(f"{error.filename or path.parent}: {error.strerror}")

    def _path(self, signature: Any, codegen: Any) -> Path:
        function = self._kernel.py_func
        kind = (function.__module__, _text(self._kernel.targetoptions), str(signature),
                codegen.magic_tuple(), numba.__version__, sys.version)  # fmt: skip
        start = f"{function.__name__}-{hashlib.sha256(repr(kind).encode()).hexdigest()[:16]}"
        return _folder() / f"{start}-{fingerprint(self._kernel)[:32]}{_SUFFIX}"

    def enable(self) -> None:
        """Use the files."""
        self._enabled = True

    def disable(self) -> None:
        """Neither read nor write files."""
        self._enabled = False

    def flush(self) -> None:
        """Nothing is kept in memory."""


def _split(data: bytes) -> tuple[bytes, bytes]:
    return data[:_DIGEST_BYTES], data[_DIGEST_BYTES:]


def _write(path: Path, data: bytes) -> None:
    """Write a file, whole or not at all; of earlier versions of its kernel, keep the newest."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
        try:
            file.write(data)
            file.flush()
            os.replace(file.name, path)
        except BaseException:
            os.unlink(file.name)
            raise
    versions = path.parent.glob(f"{path.name.rsplit('-', 1)[0]}-*{_SUFFIX}")
    with suppress(OSError):  # another process may remove them too
        for earlier in sorted(versions, key=lambda p: p.stat().st_mtime)[:-_VERSIONS_KEPT]:
            earlier.unlink()


@cache
def _folder() -> Path:
    """Where kernels are kept: the first place that can be written, or else that has some."""
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(chosen)
    places = platformdirs.user_cache_path("calibgraph"), Path(__file__).parent / "__pycache__"
    writable = (place for place in places if _is_writable(place))
    filled = (place for place in places if any(place.glob(f"*{_SUFFIX}")))
    return next(writable, None) or next(filled, places[0])


def _is_writable(folder: Path) -> bool:
    """Whether a folder can be written, or made."""
    existing = next(p for p in (folder, *folder.parents) if p.exists())
    return existing.is_dir() and os.access(existing, os.W_OK | os.X_OK)


@cache
def _report_once(why: str) -> None:
    if _report_once.cache_info().currsize == 0:
        _log.warning(
            "calibgraph: compiled code cannot be kept (%s), so every start compiles it anew; "
            "set NUMBA_CACHE_DIR to a folder that can be written",
            why,
        )
