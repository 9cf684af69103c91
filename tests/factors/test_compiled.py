"""Compiled kernels are kept where that is possible, never outdated, and never needed on disk."""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.conftest import ROOT

KERNEL = """
from factors.compiled import compiled
from factors.helper import OFFSET, twice

@compiled()
def kernel(x):
    return twice(x) + OFFSET
"""
HELPER = """
from factors.compiled import compiled
OFFSET = {offset}

@compiled()
def twice(x):
    return {factor} * x
"""
TWICE = """
from numba import prange
from factors.compiled import compiled

def _sum(n):
    total = 0
    for i in prange(n):
        total += 2
    return total

alone = compiled()(_sum)
shared = compiled(parallel=True)(_sum)
"""
CALL = "from kernels import kernel\nprint(kernel(3.0), sum(kernel.stats.cache_hits.values()))"
IGNORED = shutil.ignore_patterns("__pycache__")
LENS = (
    "import numpy as np; from factors.loss import loss_and_weight as kernel\n"
    "print(kernel(1, 2.0, 9.0), sum(kernel.stats.cache_hits.values()))"
)
HUBER = "(8.0, 0.6666666666666666)"  # 2 k r - k^2 and k / r at r = 3, k = 2
NOT_KEPT = "calibgraph: compiled code cannot be kept ("

# Root may write anywhere; without its capabilities it is held to the permissions like others.
WITHOUT_PRIVILEGES = ["setpriv", "--bounding-set", "-all", "--inh-caps", "-all"]


def run(code: str, *, path: Path | None = None, **environment: str) -> tuple[str, str]:
    """Output and errors of a process of its own, with these variables alone changed."""
    settings = {
        k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")
    }
    settings["PYTHONPATH"] = os.pathsep.join(map(str, filter(None, [path, Path.cwd()])))
    prefix = WITHOUT_PRIVILEGES if os.geteuid() == 0 else []
    done = subprocess.run(
        [*prefix, sys.executable, "-c", code],
        env=settings | environment, capture_output=True, text=True, check=True, cwd=path,
    )  # fmt: skip
    return done.stdout.strip(), done.stderr


@pytest.fixture
def read_only(tmp_path: Path) -> Path:
    """A folder that the processes of ``run`` cannot write."""
    if os.geteuid() == 0 and shutil.which("setpriv") is None:
        pytest.skip("root, and no setpriv to give up its privileges")
    folder = tmp_path / "read_only"
    folder.mkdir(mode=0o555)
    code = f"open({str(folder / 'new')!r}, 'w')"
    with pytest.raises(subprocess.CalledProcessError):
        run(code)
    return folder


def test_a_second_process_does_not_compile_again(tmp_path: Path) -> None:
    first, second = (run(LENS, NUMBA_CACHE_DIR=str(tmp_path / "new" / "cache")) for _ in range(2))
    assert first == (f"{HUBER} 0", "")
    assert second == (f"{HUBER} 1", "")


@pytest.mark.slow
def test_the_users_cache_folder_is_the_default(tmp_path: Path) -> None:
    found = [run(LENS, XDG_CACHE_HOME=str(tmp_path), HOME=str(tmp_path)) for _ in range(2)]
    assert found == [(f"{HUBER} 0", ""), (f"{HUBER} 1", "")]
    assert [*(tmp_path / "calibgraph").rglob("*loss_and_weight*")]


@pytest.mark.parametrize(
    "variable", ["NUMBA_CACHE_DIR", pytest.param("HOME", marks=pytest.mark.slow)]
)
def test_with_a_read_only_folder_kernels_are_compiled_in_memory_and_one_line_reports_it(
    variable: str, read_only: Path, tmp_path: Path
) -> None:
    """With HOME, the packages are read-only too."""
    packages = tmp_path / "packages"
    shutil.copytree("factors", packages / "factors", ignore=shutil.ignore_patterns("__pycache__"))
    (packages / "factors").chmod(0o555)
    two = LENS + "\nfrom factors.lens_kernels import is_projectable as other"
    two += "; print(other(0, np.ones(13), 0.0, 0.0, 1.0))"
    out, err = run(two, path=packages, **{variable: str(read_only)})
    assert out.splitlines() == [f"{HUBER} 0", "True"]
    assert err.startswith(NOT_KEPT) and err.count("\n") == 1
    assert "Permission denied" in err and "set NUMBA_CACHE_DIR" in err
    assert [*read_only.iterdir()] == []


def test_a_file_in_the_place_of_the_folder_is_reported_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    out, err = run(LENS, NUMBA_CACHE_DIR=str(tmp_path / "file" / "cache"))
    assert out == f"{HUBER} 0"
    assert err.startswith(NOT_KEPT) and err.count("\n") == 1


@pytest.mark.slow
def test_a_change_of_a_constant_or_a_callee_in_factors_is_noticed(tmp_path: Path) -> None:
    """Both are in another file than the kernel, whose own file stays the same."""
    shutil.copytree(ROOT / "factors", tmp_path / "factors", ignore=IGNORED)
    cache, helper = str(tmp_path / "cache"), tmp_path / "factors" / "helper.py"
    (tmp_path / "kernels.py").write_text(KERNEL)
    for factor, offset, hits in ((2.0, 1.0, 0), (2.0, 5.0, 0), (7.0, 5.0, 0), (2.0, 1.0, 1)):
        helper.write_text(HELPER.format(factor=factor, offset=offset))
        shutil.rmtree(tmp_path / "factors" / "__pycache__", ignore_errors=True)
        found = run(CALL, path=tmp_path, NUMBA_CACHE_DIR=cache)
        assert found == (f"{factor * 3.0 + offset} {hits}", "")  # the first version is kept too


def test_kernels_use_names_of_files_with_kernels_beside_theirs_and_of_factors_alone() -> None:
    """Their files are what ``compiled`` compares; a constant of another one could be outdated."""
    sources = {file: file.read_text() for file in (ROOT / "calibgraph").rglob("*.py")}
    files = {file: ast.parse(text) for file, text in sources.items() if "@compiled(" in text}
    assert len(files) > 3
    for file, tree in files.items():
        beside = {_module(other) for other in files if other.parent == file.parent}
        imported = {
            alias.asname or alias.name
            for node in tree.body if isinstance(node, ast.ImportFrom)
            for alias in node.names
            if (node.module or "").startswith("calibgraph") and node.module not in beside
        }  # fmt: skip
        kernels = [
            node for node in tree.body if isinstance(node, ast.FunctionDef)
            and any("compiled" in ast.unparse(each) for each in node.decorator_list)
        ]  # fmt: skip
        used = {
            node.id for kernel in kernels for part in kernel.body for node in ast.walk(part)
            if isinstance(node, ast.Name)
        }  # fmt: skip
        assert not used & imported, (file, used & imported)


def _module(file: Path) -> str:
    return ".".join(file.relative_to(ROOT).with_suffix("").parts)


def test_a_kernel_with_threads_is_not_taken_for_the_one_without(tmp_path: Path) -> None:
    """They are compiled from one function, with other options."""
    shutil.copytree(ROOT / "factors", tmp_path / "factors", ignore=IGNORED)
    (tmp_path / "kernels.py").write_text(TWICE)
    code = "from kernels import {0} as kernel; print(kernel(3), len(kernel.stats.cache_hits))"
    for name, hits in (("alone", 0), ("shared", 0), ("alone", 1)):
        found = run(code.format(name), path=tmp_path, NUMBA_CACHE_DIR=str(tmp_path / "cache"))
        assert found[0] == f"6 {hits}"


def test_processes_may_fill_a_cache_together(tmp_path: Path) -> None:
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: run(LENS, NUMBA_CACHE_DIR=str(tmp_path)), range(4)))
    assert {out.split()[0] for out, _ in found} == {HUBER.split(maxsplit=1)[0]}
    assert not any(err for _, err in found)
    assert run(LENS, NUMBA_CACHE_DIR=str(tmp_path)) == (f"{HUBER} 1", "")
