"""The output that the tutorial and the README show is that of the program."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from docs.transcripts import BLOCK, PAGE, run, shown
from tests.conftest import ROOT

_NUMBER = re.compile(r"[+-]?\d+(?:\.\d+)?")
_SECONDS = re.compile(r"\d+(?:\.\d+)? s;")
CALIBRATE = "calibrate data/sample --out out/sample"


@pytest.fixture(scope="module")
def printed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The output of every command of the tutorial, run in order."""
    folder = tmp_path_factory.mktemp("tutorial")
    (folder / "data").symlink_to(ROOT / "data")
    commands = [block["command"] for block in BLOCK.finditer(PAGE.read_text("utf-8"))]
    return {command: run(command, folder) for command in commands}


@pytest.mark.slow
@pytest.mark.ci
def test_the_tutorial_shows_what_the_program_prints(printed: dict[str, str]) -> None:
    for block in BLOCK.finditer(PAGE.read_text("utf-8")):
        output = shown(printed[block["command"]], block["output"])
        require_alike(block["output"].splitlines(), output.splitlines())


@pytest.mark.slow
@pytest.mark.ci
def test_the_readme_shows_the_first_lines_that_the_program_prints(printed: dict[str, str]) -> None:
    (shown,) = re.findall(r"```text\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    lines = shown.splitlines()
    require_alike(lines, printed[CALIBRATE].splitlines()[: len(lines)])


def require_alike(shown: list[str], printed: list[str]) -> None:
    """Same words in same lines; numbers within a tenth, or within 0.1 deg, cm or px."""
    assert len(shown) == len(printed), "\n".join(printed)
    for line, other in zip(shown, printed, strict=True):
        line, other = _SECONDS.sub("", line), _SECONDS.sub("", other)  # noqa: PLW2901
        words = (re.split(r"\s+", _NUMBER.sub("#", text.strip())) for text in (line, other))
        assert next(words) == next(words), f"{line}\n{other}"
        pairs = zip(_NUMBER.findall(line), _NUMBER.findall(other), strict=True)
        for wanted, found in pairs:
            assert float(found) == pytest.approx(float(wanted), rel=0.1, abs=0.1), line


@pytest.mark.parametrize("changed", ["PASS 2.9", "WARN 2.0", "PASS 2.0 1"])
def test_another_number_or_word_is_noticed(changed: str) -> None:
    require_alike(["PASS  2.0"], ["PASS 2.05"])
    with pytest.raises((AssertionError, ValueError)):
        require_alike(["PASS 2.0"], [changed])


def test_the_tutorial_has_output_for_every_command() -> None:
    blocks = [*BLOCK.finditer(PAGE.read_text("utf-8"))]
    assert len(blocks) == Path(PAGE).read_text("utf-8").count("$ calibgraph ")
    assert all(block["output"].strip() for block in blocks)
