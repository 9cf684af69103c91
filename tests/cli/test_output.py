"""A reader that has gone, a closed or full standard output, and arguments that are not UTF-8."""

from __future__ import annotations

import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import pytest

from tests.conftest import SAMPLE, Call

EVALUATE = f"evaluate {SAMPLE} {SAMPLE}/reference.yaml"


def run_in_shell(line: str) -> tuple[int, str]:
    """Exit code of the command line (not of what reads it), and what is on stderr."""
    command = f"set -o pipefail; {sys.executable} -m calibgraph {line}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    return done.returncode, done.stderr


@pytest.mark.parametrize(
    "line",
    [
        f"{EVALUATE} --json | true",
        pytest.param(f"rig {SAMPLE} --out rig.yaml 2>&1 | true", marks=pytest.mark.slow),
        "calibrate --help | true",
        "--version | true",
    ],
)
def test_a_reader_that_has_gone_is_no_error(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run_in_shell(line) == (0, "")


@pytest.mark.parametrize(
    ("to", "message"), [(None, "is closed"), ("/dev/full", "cannot be written to")]
)
def test_json_that_cannot_be_printed_is_one_line(
    to: str | None, message: str, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open(to, "w") if to else nullcontext() as stdout, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", stdout)
        code, _, stderr = call(*EVALUATE.split(), "--json")
    assert code == 2
    assert stderr.startswith("calibgraph: standard output") and message in stderr
    assert stderr.count("\n") == 1


def test_an_argument_that_is_not_utf8_is_one_line() -> None:
    code, stderr = run_in_shell("evaluate $'\\xff.yaml' rig.yaml")
    assert code == 2
    assert "not UTF-8; rename" in stderr and stderr.count("\n") == 1
