"""Compiled kernels are kept where that is possible, never outdated, and never needed on disk."""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from numba import prange

from factors.compiled import compiled, has_kernels
from tests.conftest import ROOT

PACKAGES = "calibgraph", "factors"
IMPORT = "from factors.compiled import compiled"
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
LOSS = (
    "import numpy as np; from factors.loss import loss_and_weight as kernel\n"
    "print(kernel(1, 2.0, 9.0), sum(kernel.stats.cache_hits.values()))"
)
NOT_IN_KERNELS = {
    "Array", "Mask", "Config", "Correspondences", "Rig", "Camera", "Mesh", "ShiftScores", "Level",
    "FileError", "needs_extra", "contiguous", "unproject", "LEVELS", "RawCloud", "choose_fields",
    "lines_of_text", "raw_cloud", "read_count", "read_rows", "too_long",
}  # fmt: skip
"""What files with kernels import from files without, for functions that are no kernels."""
HUBER = "(8.0, 0.6666666666666666)"  # 2 k r - k^2 and k / r at r = 3, k = 2
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


def test_a_second_process_does_not_compile_again(tmp_path: Path) -> None:
    """The folders are made where there are none, for the user alone."""
    cache = tmp_path / "new" / "cache"
    found = [run(LOSS, NUMBA_CACHE_DIR=str(cache)) for _ in range(2)]
    assert found == [(f"{HUBER} 0", ""), (f"{HUBER} 1", "")]
    made = cache.parent, cache, *cache.iterdir()
    assert {each.stat().st_mode & 0o777 for each in made} == {0o700}


def test_a_second_process_finds_the_kernels_of_a_lens(tmp_path: Path) -> None:
    """One that encloses another kernel would be compiled anew each time: numba cannot name it."""
    code = (
        "import numpy as np; from factors.kernel import accumulate, evaluate\n"
        "from factors import Lens, ProjectionBlock; import gtsam\n"
        "lens = Lens.pinhole(fx=500, fy=500, cx=320, cy=240)\n"
        "block = ProjectionBlock(lens, np.ones((9, 3)), np.ones((9, 2)))\n"
        "block.sums(gtsam.Pose3()), block.residuals(gtsam.Pose3())\n"
        "kernels = accumulate(0, shared=False), evaluate(0, norms=False, shared=False)\n"
        "print([sum(kernel.stats.cache_hits.values()) for kernel in kernels])"
    )
    found = [run(code, NUMBA_CACHE_DIR=str(tmp_path))[0] for _ in range(2)]
    assert found == ["[0, 0]", "[1, 1]"]


@pytest.mark.slow
def test_the_users_cache_folder_is_the_default(tmp_path: Path) -> None:
    found = [run(LOSS, XDG_CACHE_HOME=str(tmp_path), HOME=str(tmp_path)) for _ in range(2)]
    assert found == [(f"{HUBER} 0", ""), (f"{HUBER} 1", "")]
    assert [*(tmp_path / "calibgraph").glob("factors.loss-*/*/loss.loss_and_weight*.nbi")]


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
    two = LOSS + "\nfrom factors.conditioning import root_of_sums as other"
    two += "; print(other(np.zeros(28), np.empty(7), np.zeros((6, 7))))"
    out, err = run(two, path=packages, **{variable: str(read_only)})
    assert out.splitlines() == [f"{HUBER} 0", "False"]
    assert err.startswith(NOT_KEPT) and err.count("\n") == 1
    assert "Permission denied" in err and "set NUMBA_CACHE_DIR" in err
    assert [*read_only.iterdir()] == []


BY_ANOTHER = "import os; os.geteuid = lambda: 4242\n"


@pytest.mark.parametrize(
    ("spoil", "code", "why"),
    [
        (lambda index: index.parents[1].chmod(0o777), LOSS, ": others may write it"),
        (lambda index: index.parents[2].chmod(0o777), LOSS, ": others may write it"),
        (lambda index: index.chmod(0o666), LOSS, ": others may write it"),
        (lambda index: index.symlink_to(index.rename(index.with_name("x"))), LOSS, ": others may"),
        (lambda index: None, BY_ANOTHER + LOSS, ": belongs to another user)"),
    ],
    ids=["folder", "folder above", "file", "link", "another user's"],
)
def test_code_that_another_user_may_have_written_is_not_loaded(
    tmp_path: Path, spoil: Callable[[Path], object], code: str, why: str
) -> None:
    """numba's index is a pickle: this one would make a file."""
    cache, made = tmp_path / "above" / "cache", tmp_path / "made"
    run(LOSS, NUMBA_CACHE_DIR=str(cache))
    (index,) = cache.rglob("*loss_and_weight*.nbi")
    index.write_bytes(b"cbuiltins\nopen\n(V%b\nVw\ntR." % bytes(made))
    spoil(index)
    out, err = run(code, NUMBA_CACHE_DIR=str(cache))
    assert out == f"{HUBER} 0" and not made.exists()
    assert err.startswith(NOT_KEPT) and err.count("\n") == 1 and why in err


def test_a_file_in_the_place_of_the_folder_is_reported_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    out, err = run(LOSS, NUMBA_CACHE_DIR=str(tmp_path / "file" / "cache"))
    assert out == f"{HUBER} 0"
    assert err.startswith(NOT_KEPT) and err.count("\n") == 1


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


KERNEL_FILES = [
    file
    for package in PACKAGES
    for file in (ROOT / package).rglob("*.py")
    if has_kernels(file.read_text())
]


@pytest.mark.parametrize("file", KERNEL_FILES, ids=lambda file: file.stem)
def test_files_with_kernels_use_such_files_and_a_few_other_names(file: Path) -> None:
    """So the files of the cache are all that determines their code."""
    modules = {".".join(each.relative_to(ROOT).with_suffix("").parts) for each in KERNEL_FILES}
    assert foreign_names(ast.parse(file.read_bytes()), modules) == set()


@pytest.mark.parametrize(
    "text",
    [
        "from factors.block import K",
        "from factors.block import K as contiguous",
        "from .block import K",
        "from factors import block",
        "import factors.block as b",
        "try:\n    from factors.block import K\nexcept ImportError:\n    K = 1",
        "from factors.block_arrays import contiguous\n"
        "@compiled()\ndef kernel(x):\n    return contiguous(x)",
        "def change():\n    global K\n    K = 2",
    ],
)
def test_a_name_from_elsewhere_is_found(text: str) -> None:
    assert foreign_names(ast.parse(text), {"factors.loss"})


def foreign_names(module: ast.Module, known: set[str]) -> set[str]:
    """What a file with kernels has from other modules of ours, but for what no kernel uses."""
    found = set[str]()
    for node in ast.walk(module):
        if isinstance(node, ast.Global):
            found |= {*node.names}
        elif isinstance(node, ast.FunctionDef):
            found |= _used_by(node) & NOT_IN_KERNELS
        elif isinstance(node, ast.Import):
            found |= {name.name for name in node.names if name.name.startswith(PACKAGES)}
        elif isinstance(node, ast.ImportFrom):
            source = "factors" if node.level else str(node.module)
            if source.startswith(PACKAGES) and source not in {*known, "factors.compiled"}:
                found |= {ast.unparse(name) for name in node.names} - NOT_IN_KERNELS
    return found


def _used_by(function: ast.FunctionDef) -> set[str]:
    """The names in a kernel, without its annotations and decorators; none of other functions."""
    decorators, body = (
        {name.id for each in part for name in ast.walk(each) if isinstance(name, ast.Name)}
        for part in (function.decorator_list, function.body)
    )
    return body if "compiled" in decorators else set()


def test_constants_are_assigned_in_their_own_module_and_the_decorator_has_its_name() -> None:
    for file in (file for folder in PACKAGES for file in (ROOT / folder).rglob("*.py")):
        assert departures(ast.parse(file.read_bytes())) <= {"_config.CACHE_DIR"}, file


@pytest.mark.parametrize(
    "text", ["loss.K = 2", "loss.K += 2", f"{IMPORT} as jit", "@c.compiled()\ndef f():\n    pass"]
)
def test_a_constant_assigned_from_elsewhere_and_another_decorator_are_found(text: str) -> None:
    assert departures(ast.parse(text))


def departures(module: ast.Module) -> set[str]:
    """Constants of others that are assigned, and other names of the decorator."""
    return {
        ast.unparse(node)
        for node in ast.walk(module)
        if (isinstance(node, ast.alias) and node.name == "compiled" and node.asname)
        or (
            isinstance(node, ast.Attribute)
            and isinstance(node.ctx, ast.Store)
            and node.attr.isupper()
        )
        or (isinstance(node, ast.Attribute) and node.attr == "compiled")
    }


def test_code_that_no_process_has_used_for_a_week_is_removed(tmp_path: Path) -> None:
    old, recent = tmp_path / "factors.loss-old", tmp_path / "factors.loss-recent"
    old.mkdir()
    recent.mkdir()
    os.utime(old, (0, 0))
    run(LOSS, NUMBA_CACHE_DIR=str(tmp_path))
    assert recent.exists() and not old.exists()


def test_kernels_of_two_kinds_of_lens_and_of_all_cores_are_kept_apart(tmp_path: Path) -> None:
    code = (
        "import numpy as np; from factors import Lens\n"
        "points = np.array([[0.3, 0.2, 1.0]])\n"
        "size = dict(fx=1.0, fy=1.0, cx=0.0, cy=0.0)\n"
        "for lens in (Lens.pinhole(**size), Lens.equirectangular(**size)):\n"
        "    print(lens.project(points)[0].round(3).tolist())"
    )
    found = {run(code, NUMBA_CACHE_DIR=str(tmp_path)) for _ in range(2)}
    assert found == {("[[0.3, 0.2]]\n[[0.291, 0.189]]", "")}
    # Each has its own index: processes that make several at a time mix up the numbers of one.
    assert len([*tmp_path.rglob("*_project_many*.nbi")]) == 2
    code = (
        "import numpy as np; from factors.compiled import compiled\n"
        "from tests.factors.test_compiled import totals\n"
        "print([totals(shared)(np.ones(3)) for shared in {order}])\n"
        "print([sum(totals(shared).stats.cache_hits.values()) for shared in {order}])"
    )
    for order, hits in (((True,), [0]), ((False, True), [0, 1])):
        printed, _ = run(code.format(order=order), path=ROOT, NUMBA_CACHE_DIR=str(tmp_path))
        assert printed == f"{[3.0] * len(order)}\n{hits}"


def test_a_name_is_the_same_in_every_process() -> None:
    """Also of a set of options, whose order is not."""
    code = "from factors.kernel_sums import sum_tile\nprint(sum_tile.py_func.__qualname__)"
    assert len({run(code, PYTHONHASHSEED=str(seed)) for seed in range(4)}) == 1


def test_threads_that_make_kernels_keep_them_in_the_folder(tmp_path: Path) -> None:
    code = (
        "import sys; sys.setswitchinterval(1e-6)\n"
        "from concurrent.futures import ThreadPoolExecutor\n"
        "import numba, numpy as np\n"
        "from tests.factors.test_compiled import totals\n"
        "with ThreadPoolExecutor(8) as pool:\n"
        "    kernels = list(pool.map(lambda _: totals.__wrapped__(False), range(200)))\n"
        "print({kernel._cache.cache_path.startswith(sys.argv[1]) for kernel in kernels})\n"
        "print(numba.config.CACHE_DIR == sys.argv[1])"
    )
    code = f"import sys; sys.argv = ['', {str(tmp_path)!r}]\n{code}"
    printed, _ = run(code, path=ROOT, NUMBA_CACHE_DIR=str(tmp_path))
    assert printed == "{True}\nTrue"


@cache
def totals(shared: bool) -> Any:
    """A kernel that all cores share, or not, of the same source."""

    @compiled(parallel=shared)
    def total(values):  # type: ignore[no-untyped-def]
        found = 0.0
        for i in prange(len(values)):
            found += values[i]
        return found

    return total
