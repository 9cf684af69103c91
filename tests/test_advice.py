"""What messages advise can be done as it is printed: commands exist, with their options."""

import ast
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
import pytest
from typer.main import get_command

import calibgraph
from calibgraph import Camera, Config, Rig
from calibgraph.cli.app import app
from calibgraph.cli.settings import RareSettings
from calibgraph.errors import CorrespondenceError
from calibgraph.matching.named import find_matcher
from calibgraph.matching.run import require_known_motion
from calibgraph.model.causes import CAUSES
from calibgraph.model.error_sources import _ADVICE
from calibgraph.model.summary import summarize
from calibgraph.model.verdict import Verdict
from calibgraph.trust import lens_checks
from calibgraph.trust.conventions import _sentence, undo_convention_errors
from calibgraph.trust.lens_checks import _motion_options
from calibgraph.trust.lens_parameter import IMAGES, TIME, LensParameter, check_parameter
from calibgraph.trust.thresholds import THRESHOLDS
from tests.conftest import ROOT, SAMPLE, Call

COMMANDS = get_command(app).commands  # type: ignore[attr-defined]
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]+")
COMMAND = re.compile(r"calibgraph ([a-z][a-z-]*)((?: (?:[A-Z.]+|\{\}|--[a-z-]+ \S+))*)")


def options_of(name: str) -> set[str]:
    return {flag for option in COMMANDS[name].params for flag in option.opts}


def texts_of(path: Path) -> Iterator[str]:
    """The string constants of a file; what is put into them is {}."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    parts = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr)
             for part in node.values}  # fmt: skip
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            yield "".join(v.value if isinstance(v, ast.Constant) else "{}" for v in node.values)
        elif isinstance(node, ast.Constant) and id(node) not in parts:
            yield str(node.value)


def test_every_option_and_command_that_a_message_names_exists() -> None:
    of_ros = "x y z qx qy qz qw frame-id child-frame-id once ros-args qos-durability"
    others = {
        f"--{name}"
        for name in (*of_ros.split(), "index-url", "debug", "help", "version", "no-show")
    }
    known = {flag for name in COMMANDS for flag in options_of(name)} | others
    wrong = []
    for path in (ROOT / "calibgraph").rglob("*.py"):
        for text in texts_of(path):
            wrong += [(path.name, option) for option in OPTION.findall(text) if option not in known]
            for name, words in COMMAND.findall(text):
                if name not in COMMANDS or not {*OPTION.findall(words)} <= options_of(name):
                    wrong.append((path.name, f"{name}{words}"))
    prose = {"that", "cannot", "has", "needs", "is", "does", "graph", "wrote"}
    assert [each for each in wrong if each[1].split()[0] not in prose] == []


KEYS = {
    *Config.model_fields, *RareSettings.model_fields, *Rig.model_fields, *Camera.model_fields,
    "systematic_rotation_rad", "systematic_translation_m",  # of a table
}  # fmt: skip


def test_what_to_do_has_options_of_calibrate_and_keys_of_rigs_and_settings() -> None:
    actions = [text for cause in CAUSES.values() for text in (cause.action, *cause.kinds.values())]
    of_bars = [*texts_of(ROOT / "calibgraph" / "model" / "error_sources.py")]
    advice = " ".join([*actions, *_ADVICE.values(), *(t for t in of_bars if "Tolerate" in t),
                       *(row.advice for row in THRESHOLDS)])  # fmt: skip
    of_solve = {"--common-deg", "--common-cm"}
    assert {*OPTION.findall(advice)} <= options_of("calibrate") | of_solve
    keys = {*re.findall(r"\b(?!p_)[a-z]+(?:_[a-z0-9]+)+\b", advice)}
    assert {"tolerance_deg", "common_cm", "relative_poses"} <= keys <= KEYS


@pytest.mark.parametrize("error", undo_convention_errors(np.eye(4)))
def test_the_command_that_undoes_a_mistake_of_the_guess_runs(
    error: str, tmp_path: Path, call: Call
) -> None:
    out = tmp_path / "rig.yaml"
    _, command = _sentence(error, ["left"] if error == "inverse" else []).split("calibgraph ")
    words = [{"RIG": SAMPLE, "FILE.yaml": out}.get(word, word) for word in shlex.split(command)]
    code, _, err = call(*words)
    assert code == 0, err
    given, written = calibgraph.load_rig(SAMPLE), calibgraph.load_rig(out)
    expected = undo_convention_errors(given.cameras["left"].T_camera_lidar)[error]
    np.testing.assert_allclose(written.T_camera_lidar["left"], expected, atol=1e-9)
    right = given.T_camera_lidar["front_right"]
    assert (written.T_camera_lidar["front_right"] == right).all() == (error == "inverse")


def test_the_offset_that_scans_show_is_estimated_with_the_interval_of_clouds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The advice of the check becomes the action, with all that the command needs."""
    sample = calibgraph.load_dataset(SAMPLE)
    late = LensParameter(TIME, np.array([9.0]), np.array([0.1]), np.full(6, 0.1), np.ones(1))
    check = check_parameter(late, IMAGES, options=_motion_options(sample))
    assert check.text.endswith("or run with --estimate offset --interval-s 0.1")
    (action,) = summarize({"left": Verdict((check,))}).actions
    assert action.endswith("estimate the time of the images: --estimate offset --interval-s 0.1.")
    words = action.rstrip(".").partition(": ")[2].split()
    context: click.Context = COMMANDS["calibrate"].make_context("calibrate", [str(SAMPLE), *words])
    assert context.params["dataset"] == [SAMPLE]
    monkeypatch.setattr(lens_checks, "is_bag", lambda _: True)
    assert _motion_options(sample) == " --motion scans"


@pytest.mark.realdata
def test_with_the_interval_the_offset_of_a_drive_can_be_estimated(realdata: Path) -> None:
    drive, matcher = realdata / "kitti_odometry" / "sequences" / "05", find_matcher("structure")
    with pytest.raises(CorrespondenceError, match="give --interval-s with folders"):
        require_known_motion(calibgraph.load_dataset(drive), matcher, ["offset"])
    data = calibgraph.load_dataset(drive, interval_s=0.1)
    require_known_motion(data, matcher, ["offset"])
    assert all(frame.twist_per_s is not None for frame in data.frames)
