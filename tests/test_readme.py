"""What the README says, run."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import calibgraph
from tests.conftest import ROOT

README = (ROOT / "README.md").read_text()


def test_the_python_example_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    (tmp_path / "data").symlink_to(ROOT / "data")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile(code, "README.md", "exec"), names)
    result = names["result"]
    assert isinstance(result, calibgraph.Calibration)
    assert result.verdict.status == "PASS"
    assert (tmp_path / "out" / "python" / "calibration.yaml").is_file()


def test_the_rig_example_is_a_rig(tmp_path: Path) -> None:
    text = re.search(r"    format: calibgraph-rig/1\n.*?\n    relative_poses", README, re.DOTALL)
    assert text is not None
    lines = [line.removeprefix("    ") for line in text[0].splitlines()[:-1]]
    (tmp_path / "rig.yaml").write_text("\n".join(lines))
    assert list(calibgraph.load_rig(tmp_path / "rig.yaml").cameras) == ["front"]


def test_every_public_name_is_there_and_documented() -> None:
    for name in calibgraph.__all__:
        assert getattr(calibgraph, name).__doc__, name


def test_the_names_that_types_see_are_the_names_that_run() -> None:
    stub = (ROOT / "calibgraph" / "__init__.pyi").read_text()
    assert set(re.findall(r"import \w+ as (\w+)", stub)) == set(calibgraph.__all__)


def test_every_command_of_the_readme_exists() -> None:
    from typer.main import get_command

    from calibgraph.cli import app

    named = set(re.findall(r"^    calibgraph (\w+)", README, flags=re.MULTILINE))
    assert named == set(get_command(app).commands)
