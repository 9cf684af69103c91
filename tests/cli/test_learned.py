"""The commands `weights`, `train` and `train-windows`, and `calibrate` with the matcher cmrnext."""

from __future__ import annotations

import json
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from pydantic import BaseModel

import calibgraph
from calibgraph import Rig, load_rig
from calibgraph.matching.cmrnext import TrainSettings, load_checkpoint
from calibgraph.matching.structure.training import WindowSettings
from calibgraph.matching.structure.window_weights import (
    PACKAGE_FILE,
    load_window_network,
    window_network,
)
from tests.conftest import SAMPLE, Call
from tests.matching.cmrnext.builders import good_content, saved


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained network."""
    return saved(tmp_path_factory.mktemp("weights") / "random.tar", good_content())


def test_weights_are_checked_and_converted(weights: Path, tmp_path: Path, call: Call) -> None:
    bad = tmp_path / "bad.tar"
    bad.write_bytes(weights.read_bytes()[:-5000])
    code, _, line = call("weights", bad)
    assert code == 2
    assert line.count("\n") == 1
    converted = tmp_path / "good.safetensors"
    assert call("weights", weights, "--out", converted)[0] == 0
    code, _, line = call("weights", converted, "--out", converted)
    assert code == 2 and "is read by this command" in line
    described = json.loads(call("weights", converted, "--json")[1])
    assert described["network"]["fourier_levels"] == 12
    assert described["config"]["max_r"] == 1.0


@pytest.mark.slow
def test_untrained_weights_fail_on_the_command_line(
    weights: Path, tmp_path: Path, call: Call
) -> None:
    rig, out = tmp_path / "rig.yaml", tmp_path / "out"
    left = load_rig(SAMPLE).cameras["front_left"]
    Rig(cameras={"front_left": left}).save(rig)
    files = ("--weights", weights, weights, weights)
    code, _, text = call(
        "calibrate", SAMPLE, "--rig", rig, "--frames", "0:1", "--matcher", "cmrnext", *files,
        "--out", out, "--half-resolution", "--iterations", 2,
    )  # fmt: skip
    assert code == 1
    assert "FAIL" in text
    table = calibgraph.load_correspondences(out / "correspondences.parquet")
    assert len(table.metadata["schedule"]) == 3
    assert table.metadata["half_resolution"] is True
    # The table alone can be solved again, without the network, with the same verdict.
    code, _, text = call("solve", rig, out / "correspondences.parquet", "--out", tmp_path / "o")
    assert code == 1 and "of a displaced start remains" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--matcher", "cmrnext"), "needs weights"),
        (("--matcher", "cmrnext", "--weights", "nowhere.tar"), "no such file of weights"),
        (("--weights", "a.tar"), "--weights is for --matcher cmrnext only"),
        (("--window-weights", "nowhere.json"), "nowhere.json: no such file"),
        (("--window-weights", "{w}"), "is not a text file"),
        (
            ("--window-weights", str(PACKAGE_FILE.parents[2] / "trust" / "probability.json")),
            "no window weights: ",
        ),
        (("--matcher", "a.parquet", "--window-weights", "none"), "for --matcher structure only"),
        (
            ("--matcher", "cmrnext", "--weights", "{w}", "--window-weights", "a.json"),
            "--window-weights is for --matcher structure only",
        ),
        (("--start-from", "joint"), "--start-from is for --matcher cmrnext only"),
        (("--matcher", "cmrnext", "--weights", "{w}", "--start-from", "both"), "known are frame"),
        (("--matcher", "cmrnext", "--estimate", "joint"), "give --start-from joint"),
        (("--matcher", "cmrnext", "--weights", "{w}", "--device", "tpu"), "known are auto, cpu"),
    ],
)
def test_wrong_options_are_refused(
    weights: Path, call: Call, tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    given = [text.format(w=weights) for text in arguments]
    code, _, line = call("calibrate", SAMPLE, *given, "--out", tmp_path / "o")
    assert code == 2
    assert message in line and line.count("\n") == 1


def test_missing_torch_is_reported_in_one_line(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in list(sys.modules):
        if name.startswith("calibgraph.matching.cmrnext"):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    code, _, line = call("weights", "iter1.tar")
    assert code == 2
    assert "pip install 'calibgraph[learned]'" in line and line.count("\n") == 1


def test_training_runs_on_the_command_line(tmp_path: Path, call: Call) -> None:
    out, settings, rig = tmp_path / "net.tar", tmp_path / "small.yaml", tmp_path / "rig.yaml"
    settings.write_text("steps: 1\nwidth: 8\ncrop_px: [128, 192]\niterations: 1\nbatch: 1\n")
    Rig(cameras={"left": load_rig(SAMPLE / "reference.yaml").cameras["left"]}).save(rig)
    given = ("train", SAMPLE, "--rig", rig, "--out", out, "--config", settings)
    code, _, text = call(*given, "--seed", 3)
    assert code == 0
    assert "held out: flow error" in text
    assert load_checkpoint(out).config["train_seed"] == 3
    resolved = yaml.safe_load((tmp_path / "net.settings.yaml").read_text())
    assert resolved.keys() == TrainSettings.model_fields.keys()
    assert (resolved["seed"], resolved["width"], resolved["learning_rate"]) == (3, 8, 3e-4)
    assert call("weights", out)[0] == 0
    code, _, text = call(*given)
    assert code == 2 and "is there already" in text and text.count("\n") == 1
    code, _, text = call("train", SAMPLE, "--out", out, "--resume")
    assert code == 2 and "has had all its 1 steps" in text


def test_training_refuses_misuse_in_one_line(tmp_path: Path, call: Call) -> None:
    out, wrong = tmp_path / "net.tar", tmp_path / "wrong.yaml"
    beside = tmp_path / "mine.settings.yaml"
    beside.write_text("steps: 1\n")
    wrong.write_text("width: 12\n")
    good = tmp_path / "good.yaml"
    good.write_text("steps: 1\n")
    for arguments, message in (
        ((SAMPLE, "--out", tmp_path / "c.tar", "--config", wrong), "width 12"),
        ((SAMPLE, "--out", tmp_path / "mine.tar", "--config", beside), "is read by this"),
        ((SAMPLE, "--out", tmp_path / "mine.tar"), "was not written by calibgraph train"),
        ((SAMPLE, "--out", out, "--config", tmp_path / "none.yaml"), "no such file"),
        ((SAMPLE, "--out", out, "--config", good, "--resume"), "--config: --resume goes on"),
        ((SAMPLE, "--out", out, "--seed", 0, "--resume"), "--seed: --resume goes on"),
        ((SAMPLE, "--out", out, "--seed", 2**31), "seed: .*less than 2147483648"),
        ((tmp_path / "nothing", "--out", out), "nothing"),
    ):
        code, _, line = call("train", *arguments)
        assert code == 2 and line.count("\n") == 1
        assert re.search(message, line)
    assert not out.exists()


@pytest.mark.parametrize(
    ("command", "settings"), [("train", TrainSettings), ("train-windows", WindowSettings)]
)
def test_default_settings_are_printed(call: Call, command: str, settings: type[BaseModel]) -> None:
    code, printed, _ = call(command, "--print-settings")
    assert code == 0
    assert settings.model_validate(yaml.safe_load(printed)) == settings()


def test_windows_are_trained_on_the_command_line(tmp_path: Path, call: Call) -> None:
    out, settings, start = (tmp_path / name for name in ("own.json", "small.yaml", "start.json"))
    settings.write_text("epochs: 4\nframes: 2\nbatch: 1\nnoise: 0\nlearning_rate: 1e-2\n")
    *hidden, (matrix, bias) = window_network().layers
    # The worst windows count most, and what is learned is held out: training helps for certain.
    replace(window_network(), layers=(*hidden, (-matrix, -bias))).save(start)
    alike = shutil.copytree(SAMPLE, tmp_path / "alike")
    shipped, given = PACKAGE_FILE.read_bytes(), ("--config", settings, "--held-out", alike)
    code, _, text = call(
        "train-windows", SAMPLE, "--out", out, "--from", start, *given, "--seed", 2
    )
    assert code == 0
    number = r"(-?\d+\.\d{3})"
    over = r"\(mean over 3 cameras, its change known to \+- \d\.\d{3}\)"
    found = re.search(rf"pose {number} -> {number}, held out {number} -> {number} {over}", text)
    assert found is not None
    before, after, held_before, held_after = map(float, found.groups())
    assert after < before - 0.05 and (held_before, held_after) == (before, after)
    network = load_window_network(out)
    assert "seed 2" in network.how and "3 cameras" in network.how
    assert not np.allclose(network.layers[0][0], load_window_network(start).layers[0][0], atol=1e-3)
    # Its own file may be replaced, and begun with; another one may not.
    code, _, text = call(
        "train-windows", SAMPLE, "--out", tmp_path / "next.json", "--from", out, *given
    )
    begun = re.search(rf"held out {number} -> {number} {over}", text)
    # Of the file's five digits three decimals are those of the training, but for the last.
    assert code == 0 and begun is not None
    assert float(begun[1]) == pytest.approx(held_after, abs=2e-3)
    other = tmp_path / "mine.json"
    other.write_text("{}")
    for arguments, message in (
        ((SAMPLE, "--out", other), "was not written by calibgraph train-windows"),
        ((SAMPLE, "--out", out, "--held-out", SAMPLE), "is learned from and held out"),
        ((SAMPLE, "--out", out, "--from", out), "is read by this command"),
        ((SAMPLE, "--out", tmp_path / "a.json", "--from", other), "no window weights: "),
        ((SAMPLE, "--out", tmp_path / "a.pt"), ".json"),
        ((SAMPLE, "--out", tmp_path / "a.json", "--config", other.with_name("no.yaml")), "no such"),
        ((tmp_path / "nothing", "--out", tmp_path / "a.json"), "nothing"),
    ):
        code, _, line = call("train-windows", *arguments)
        assert code == 2 and line.count("\n") == 1
        assert re.search(message, line), line
    assert PACKAGE_FILE.read_bytes() == shipped


def test_windows_that_get_no_better_leave_the_old_weights(tmp_path: Path, call: Call) -> None:
    out, settings = tmp_path / "own.json", tmp_path / "too_fast.yaml"
    settings.write_text("epochs: 2\nframes: 2\nlearning_rate: 1\n")
    window_network().save(out)
    good = out.read_bytes()
    given = ("train-windows", SAMPLE, "--config", settings)
    code, _, line = call(*given, "--out", out)
    assert code == 2 and line.count("\n") == 1
    found = re.search(r"own.json: is not written: .* no better \((\S+) -> (\S+), ", line)
    assert found is not None and float(found[2]) > float(found[1])
    assert out.read_bytes() == good
    assert call(*given, "--out", tmp_path / "new.json")[0] == 2
    assert not (tmp_path / "new.json").exists()
