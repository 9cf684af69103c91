"""Compiled kernels are kept where that is possible, never outdated, and never needed on disk."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from factors.compiled import compiled, fingerprint
from factors.kernel import accumulate_alone, accumulate_shared

LOGARITHM = """
from factors.compiled import compiled
from kernels.helper import twice, OFFSET

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
INTRINSIC_HELPER = """
from numba.extending import intrinsic
OFFSET = {offset}

@intrinsic
def twice(_, x):
    def build(context, builder, signature, arguments):
        return builder.fmul(arguments[0], arguments[0].type({factor}))
    return x(x), build
"""
CALL = "from kernels.main import kernel\nprint(kernel(3.0), sum(kernel.stats.cache_hits.values()))"
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


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of kernels that a first process has compiled."""
    folder = tmp_path_factory.mktemp("kernels") / "new" / "cache"
    assert run(LENS, NUMBA_CACHE_DIR=str(folder)) == (f"{HUBER} 0", "")
    return folder


def test_a_second_process_does_not_compile_again(kept: Path) -> None:
    assert run(LENS, NUMBA_CACHE_DIR=str(kept)) == (f"{HUBER} 1", "")


@pytest.mark.slow
def test_the_users_cache_folder_is_the_default(tmp_path: Path) -> None:
    found = [run(LENS, XDG_CACHE_HOME=str(tmp_path), HOME=str(tmp_path)) for _ in range(2)]
    assert found == [(f"{HUBER} 0", ""), (f"{HUBER} 1", "")]
    assert [*(tmp_path / "calibgraph").glob("loss_and_weight-*.kernel")]


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


def test_kernels_in_a_read_only_folder_are_used(tmp_path: Path, kept: Path) -> None:
    """As in a container whose image was made with them."""
    folder = Path(shutil.copytree(kept, tmp_path / "cache"))
    folder.chmod(0o555)
    assert run(LENS, NUMBA_CACHE_DIR=str(folder)) == (f"{HUBER} 1", "")


@pytest.mark.parametrize("damage", [b"", b"nonsense", None])
@pytest.mark.slow
def test_damaged_files_are_compiled_anew(tmp_path: Path, damage: bytes | None) -> None:
    run(LENS, NUMBA_CACHE_DIR=str(tmp_path))
    (file,) = tmp_path.glob("loss_and_weight-*.kernel")
    whole = file.read_bytes()
    file.write_bytes(whole[:-100] + bytes(100) if damage is None else damage)
    assert run(LENS, NUMBA_CACHE_DIR=str(tmp_path)) == (f"{HUBER} 0", "")
    assert run(LENS, NUMBA_CACHE_DIR=str(tmp_path)) == (f"{HUBER} 1", "")


@pytest.mark.parametrize("helper", [HELPER, INTRINSIC_HELPER])
@pytest.mark.slow
def test_a_change_of_a_callee_or_a_constant_is_noticed(helper: str, tmp_path: Path) -> None:
    """Both are in another file than the kernel, whose own file stays the same."""
    folder, cache = tmp_path / "kernels", str(tmp_path / "cache")
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "main.py").write_text(LOGARITHM)
    for factor, offset, hits in ((2.0, 1.0, 0), (2.0, 5.0, 0), (7.0, 5.0, 0), (2.0, 1.0, 1)):
        (folder / "helper.py").write_text(helper.format(factor=factor, offset=offset))
        shutil.rmtree(folder / "__pycache__", ignore_errors=True)  # Python compares times
        found = run(CALL, path=tmp_path, NUMBA_CACHE_DIR=cache)
        assert found == (f"{factor * 3.0 + offset} {hits}", "")  # the first version is kept too


@pytest.mark.slow
def test_few_versions_of_a_kernel_are_kept(tmp_path: Path) -> None:
    folder = tmp_path / "kernels"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "main.py").write_text(LOGARITHM)
    two_kept = "import factors.compiled; factors.compiled._VERSIONS_KEPT = 2\n"
    for offset in range(3):
        (folder / "helper.py").write_text(HELPER.format(factor=2.0, offset=offset))
        shutil.rmtree(folder / "__pycache__", ignore_errors=True)
        run(two_kept + CALL, path=tmp_path, NUMBA_CACHE_DIR=str(tmp_path / "cache"))
    assert len([*(tmp_path / "cache").glob("kernel-*.kernel")]) == 2


def test_a_kernel_with_threads_is_not_taken_for_the_one_without() -> None:
    """They are compiled from one function, with other options."""
    assert accumulate_alone.py_func is accumulate_shared.py_func
    assert fingerprint(accumulate_alone) != fingerprint(accumulate_shared)


def test_a_global_that_cannot_be_compared_is_refused() -> None:
    with pytest.raises(TypeError, match="which is not compared; give it as an argument"):
        fingerprint(_kernel_of_an_object)


_OBJECT = object()


@compiled()
def _kernel_of_an_object(x):  # type: ignore[no-untyped-def]
    return x if _OBJECT is None else -x
