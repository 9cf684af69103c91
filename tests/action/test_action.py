"""The GitHub Action: its file by the documented keys, and its steps as a runner runs them."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from calibgraph import Audit, CameraAudit, load_dataset, load_rig
from calibgraph.audit import audit_summary
from calibgraph.audit.result import AuditStatus
from tests.audit.deployed import motion, with_camera_moved
from tests.conftest import ROOT, SAMPLE
from tests.docs_text import resolve, takes

FOLDER = ROOT / "action"
ACTION: dict[str, Any] = yaml.safe_load((FOLDER / "action.yml").read_text())
PAGE = (ROOT / "docs" / "ci.md").read_text()

# docs.github.com, "Metadata syntax reference": keys of composite actions.
TOP = {"name", "author", "description", "inputs", "outputs", "runs", "branding"}
INPUT = {"description", "required", "default", "deprecationMessage"}
STEP = {"name", "id", "if", "run", "shell", "uses", "with", "env", "working-directory",
        "continue-on-error"}  # fmt: skip


def test_the_file_has_the_keys_of_a_composite_action() -> None:
    assert {"name", "description", "runs"} <= set(ACTION) <= TOP
    assert set(ACTION["runs"]) == {"using", "steps"}
    assert ACTION["runs"]["using"] == "composite"
    for given in ACTION["inputs"].values():
        assert "description" in given
        assert set(given) <= INPUT
        assert given.get("required") or isinstance(given["default"], str)
    for output in ACTION["outputs"].values():
        assert set(output) == {"description", "value"}
    for step in ACTION["runs"]["steps"]:
        assert set(step) <= STEP
        assert ("run" in step) != ("uses" in step)
        assert ("shell" in step) == ("run" in step)


def test_expressions_name_inputs_and_steps_that_exist() -> None:
    text = (FOLDER / "action.yml").read_text()
    inputs = set(re.findall(r"inputs\.([\w-]+)", text))
    assert inputs == set(ACTION["inputs"])
    steps = {step.get("id") for step in ACTION["runs"]["steps"]}
    assert {id for id, _ in re.findall(r"steps\.(\w+)\.outputs\.(\w+)", text)} <= steps


def test_no_input_is_part_of_a_command_and_actions_of_others_are_pinned() -> None:
    for step in ACTION["runs"]["steps"]:
        assert "${{" not in step.get("run", "")
        if "uses" in step:
            assert re.fullmatch(r"[\w./-]+@[0-9a-f]{40}", step["uses"])


@dataclass(frozen=True)
class Ran:
    """A step as a runner sees it."""

    code: int
    stdout: str
    outputs: dict[str, str]
    summary: str


def run_check(
    folder: Path, rig: Path, dataset: object, programs: Path | None = None, **inputs: str
) -> Ran:
    """The step of the action with these inputs, and defaults for the others.

    Args:
        folder: for what it writes.
        rig: of the inputs.
        dataset: of the inputs.
        programs: a folder with the ``python`` to run; this one's if None.
        inputs: the others.
    """
    (step,) = (step for step in ACTION["runs"]["steps"] if step.get("id") == "check")
    given = {name: each.get("default", "") for name, each in ACTION["inputs"].items()}
    given |= {"rig": str(rig), "dataset": str(dataset)}
    given |= {name.replace("_", "-"): value for name, value in inputs.items()}
    names = {key: re.findall(r"inputs\.([\w-]+)", text)[0] for key, text in step["env"].items()}
    environment = {
        **os.environ,
        "PATH": f"{programs or Path(sys.executable).parent}:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "GITHUB_ACTION_PATH": str(FOLDER),
        "GITHUB_OUTPUT": str(folder / "output"),
        "GITHUB_STEP_SUMMARY": str(folder / "summary.md"),
        "RUNNER_TEMP": str(folder),
        **{key: given[name] for key, name in names.items()},
    }
    command = ["bash", "--noprofile", "--norc", "-eo", "pipefail", "-c", step["run"]]
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    lines = (folder / "output").read_text().splitlines()
    outputs = dict(line.split("=", 1) for line in lines)
    return Ran(ran.returncode, ran.stdout, outputs, (folder / "summary.md").read_text())


def stand_in(folder: Path, status: AuditStatus, code: int) -> Path:
    """A folder with a ``python`` whose ``calibgraph check`` has found this at once."""
    xi, sigma = np.array([0, 0.02, 0, 0, 0, 0]), np.full(6, 0.002)
    left = CameraAudit(status, "turned about y\nby +1.15 deg | <b>", xi, sigma, 5 * sigma)
    cameras = {"left_1": left, "blind": CameraAudit("OK", "nothing")}
    shown = load_dataset(SAMPLE).frames[0]
    audit = Audit(cameras, None, load_rig(SAMPLE), shown, (str(SAMPLE),), 0.5, 10.0, 6)
    (folder / "audit.json").write_text(json.dumps(audit_summary(audit), indent=2))
    programs = folder / "programs"
    programs.mkdir()
    python = programs / "python"
    python.write_text(
        f"""#!/bin/sh
if [ "$1" != -m ]; then exec "{sys.executable}" "$@"; fi
printf '%s\\n' "$@" > "{folder}/arguments"
cat "{folder}/audit.json"
exit {code}
"""
    )
    python.chmod(0o755)
    return programs


@pytest.mark.parametrize(
    ("status", "fail", "found", "code", "annotation"),
    [
        ("OK", "true", 0, 0, "notice"),
        ("WRONG", "false", 1, 1, "error"),
        ("CANNOT TELL", "false", 3, 0, "warning"),
        ("CANNOT TELL", "true", 3, 3, "warning"),
    ],
)
def test_a_status_is_an_exit_code_outputs_a_summary_and_an_annotation(
    tmp_path: Path, status: AuditStatus, fail: str, found: int, code: int, annotation: str
) -> None:
    programs = stand_in(tmp_path, status, found)
    ran = run_check(tmp_path, Path("my rig.yaml"), "one\ntwo\n", programs,
                    frames="0:9", tolerance_cm="5", page="a page.html",
                    fail_on_cannot_tell=fail)  # fmt: skip
    assert ran.code == code
    assert ran.outputs["status"] == status
    assert json.loads(ran.outputs["json"])["cameras"]["left_1"]["status"] == status
    assert f"## Calibration: {status}" in ran.summary
    assert "| left\\_1 |" in ran.summary
    assert "| +0.00 ± 0.11 | +1.15 ± 0.11 |" in ran.summary
    assert "| blind | OK | - | - | - | - | - | - |" in ran.summary
    assert "* left\\_1: turned about y by +1.15 deg \\| &lt;b&gt;" in ran.summary
    assert ran.stdout.startswith(f"::{annotation} title=calibgraph {status}::left_1: turned about")
    assert ran.stdout.count("\n") == 1
    assert (tmp_path / "arguments").read_text().splitlines() == [
        "-m", "calibgraph", "check", "--tolerance-deg", "0.5", "--tolerance-cm", "5", "--json",
        "--frames", "0:9", "--page", "a page.html", "--", "my rig.yaml", "one", "two",
    ]  # fmt: skip


@pytest.mark.slow
def test_the_sample_is_checked_and_a_turned_camera_fails_the_step(tmp_path: Path) -> None:
    right = SAMPLE / "reference.yaml"
    for name in ("right", "wrong"):
        (tmp_path / name).mkdir()
    ran = run_check(tmp_path / "right", right, f"{SAMPLE}\n")
    assert (ran.code, ran.outputs["status"]) == (0, "OK")
    assert set(json.loads(ran.outputs["json"])["cameras"]) == {"front_left", "front_right", "left"}
    (row,) = (line for line in ran.summary.splitlines() if line.startswith("| front\\_left |"))
    assert row.count("±") == 6
    rig = tmp_path / "deployed rig.yaml"
    with_camera_moved(load_rig(right), "left", motion(1, degrees=1)).save(rig)
    ran = run_check(tmp_path / "wrong", rig, SAMPLE)
    assert (ran.code, ran.outputs["status"]) == (1, "WRONG")
    assert "* left: turned about y (yaw) by +" in ran.summary


def test_bad_input_is_an_error_with_its_line(tmp_path: Path) -> None:
    ran = run_check(tmp_path, Path("--help"), "$(touch hacked)\n`id`")
    assert ran.code == 2
    assert ran.outputs == {"status": "ERROR", "json": ""}
    assert "## Calibration: ERROR\n\ncalibgraph: " in ran.summary
    assert "::error title=calibgraph ERROR::calibgraph: " in ran.stdout


@pytest.mark.parametrize("package", ["", "calibgraph==0.1.0"])
def test_what_is_installed_is_the_code_beside_the_action_or_what_is_named(
    tmp_path: Path, package: str
) -> None:
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\nprintf "%s\\n" "$@"\n')
    python.chmod(0o755)
    ran = subprocess.run(
        ["bash", FOLDER / "install.sh"],
        env={"PATH": f"{tmp_path}:{os.environ['PATH']}", "GITHUB_ACTION_PATH": str(FOLDER),
             "INPUT_PACKAGE": package},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    words = ran.stdout.split()
    assert words[:3] == ["-m", "pip", "install"]
    assert words[-1] == (package or str(ROOT))
    assert (str(ROOT / "constraints.txt") in words) == (not package)


def blocks_of_the_page() -> list[dict[str, Any]]:
    return [yaml.safe_load(block) for block in re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)]


def test_examples_of_the_docs_give_inputs_that_exist() -> None:
    steps = [step for block in blocks_of_the_page() for job in block.get("jobs", {}).values()
             for step in job["steps"]]  # fmt: skip
    ours = [step for step in steps if "/action@" in step.get("uses", "")]
    assert ours
    for step in ours:
        assert {"rig", "dataset"} <= set(step["with"]) <= set(ACTION["inputs"])


def test_hooks_of_the_docs_are_commands_that_exist() -> None:
    hooks = [hook for block in blocks_of_the_page() for repo in block.get("repos", ())
             for hook in repo["hooks"]]  # fmt: skip
    assert hooks
    for hook in hooks:
        program, *words = hook["entry"].split()
        command, rest = resolve(words)
        assert program == "calibgraph"
        assert takes(command, rest)
