"""Compiled kernels are kept where that is possible, never outdated, and never needed on disk."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from factors.compiled import _prepare

MAIN = """
from factors.compiled import compiled
from kernels.helper import HALF, twice
from kernels.other import NAME
OFFSET = 2 * HALF

@compiled()
def kernel(x):
    return twice(x) + OFFSET
"""
HELPER = """
from factors.compiled import compiled
HALF = {half}

@compiled()
def twice(x):
    return {factor} * x
"""
CALL = "from kernels.main import kernel\nprint(kernel(3.0), sum(kernel.stats.cache_hits.values()))"
POSES = (
    "import numpy as np; from factors.pose_kernel import exponential_times as kernel\n"
    "poses = np.eye(4)[None]; kernel(np.ones((1, 6)), poses)\n"
    "print(bool(poses[0, 0, 0] < 1), sum(kernel.stats.cache_hits.values()))"
)
NOT_KEPT = "calibgraph: compiled code is not kept ("

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


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a first process keeps, in folders that were not there."""
    cache = tmp_path_factory.mktemp("kept") / "above" / "cache"
    assert run(POSES, NUMBA_CACHE_DIR=str(cache)) == ("True 0", "")
    return cache


def test_a_second_process_does_not_compile_again(kept: Path) -> None:
    """The folders are made for the user alone."""
    assert run(POSES, NUMBA_CACHE_DIR=str(kept)) == ("True 1", "")
    made = kept.parent, kept, *kept.iterdir()
    assert {each.stat().st_mode & 0o777 for each in made} == {0o700}


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
    (packages / "second.py").write_text(HELPER.format(half=0.5, factor=2))
    two = POSES + "\nfrom second import twice; print(twice(2.0) == 4.0)"
    out, err = run(two, path=packages, **{variable: str(read_only)})
    assert out.splitlines() == ["True 0", "True"]
    assert err.startswith(NOT_KEPT) and err.count("\n") == 1
    assert "Permission denied" in err and "set NUMBA_CACHE_DIR" in err
    assert [*read_only.iterdir()] == []


@pytest.mark.ci
@pytest.mark.slow
def test_code_that_others_can_write_is_not_loaded(kept: Path, tmp_path: Path) -> None:
    """numba's index is a pickle: this one would make a file."""
    cache, made = tmp_path / "above" / "cache", tmp_path / "made"
    shutil.copytree(kept.parent, cache.parent)
    (index,) = cache.rglob("*exponential_times*.nbi")
    index.write_bytes(b"cbuiltins\nopen\n(V%b\nVw\ntR." % bytes(made))
    index.parents[1].chmod(0o777)
    out, err = run(POSES, NUMBA_CACHE_DIR=str(cache))
    assert out == "True 0" and not made.exists()
    assert err.startswith(NOT_KEPT) and err.count("\n") == 1 and ": others may write it" in err


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (lambda index: index.parents[1].chmod(0o777), "others may write it"),
        (lambda index: index.parents[2].chmod(0o777), "others may write it"),
        (lambda index: index.chmod(0o666), "others may write it"),
        (lambda index: index.symlink_to(index.rename(index.with_name("x"))), "others may write it"),
        (lambda index: None, "belongs to another user"),
    ],
    ids=["folder", "folder above", "file", "link", "another user's"],
)
def test_what_others_own_or_may_write_is_refused(
    tmp_path: Path, spoil: Callable[[Path], object], why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (index := tmp_path / "above" / "module" / "sources" / "kernel.nbi").parent.mkdir(parents=True)
    index.touch()
    for path in (index, *index.parents[:3]):
        path.chmod(0o700)
    _prepare(index.parents[1])
    spoil(index)
    if "another" in why:
        monkeypatch.setattr("os.geteuid", lambda: 4242)
    with pytest.raises(PermissionError, match=why):
        _prepare(index.parents[1])


@pytest.mark.ci
@pytest.mark.slow
def test_a_change_of_a_callee_or_a_constant_is_noticed_and_one_elsewhere_is_not(
    tmp_path: Path,
) -> None:
    """None is in the kernel's own file, which stays the same."""
    folder, cache = tmp_path / "kernels", str(tmp_path / "cache")
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "main.py").write_text(MAIN)
    cases = ((2, 1, "a", 0), (2, 5, "a", 0), (7, 5, "a", 0), (7, 5, "b", 1), (2, 1, "c", 1))
    for factor, offset, name, hits in cases:  # the last is the first: its code is kept too
        helper = HELPER.format(factor=float(factor), half=offset / 2)
        (folder / "helper.py").write_text(helper)
        (folder / "other.py").write_text(f"NAME = {name!r}")
        shutil.rmtree(folder / "__pycache__", ignore_errors=True)  # Python compares times
        found = run(CALL, path=tmp_path, NUMBA_CACHE_DIR=cache)
        assert found == (f"{factor * 3.0 + offset} {hits}", "")
