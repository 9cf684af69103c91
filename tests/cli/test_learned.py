"""The commands `weights`, `train` and `train-windows`, and `calibrate` with the matcher cmrnext."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest
import yaml

import calibgraph
from calibgraph import Rig, load_rig
from calibgraph.matching.cmrnext import TrainSettings, load_checkpoint
from calibgraph.matching.structure.window_weights import PACKAGE_FILE, load_window_network
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


def test_default_settings_are_printed(call: Call) -> None:
    code, printed, _ = call("train", "--print-settings")
    assert code == 0
    assert TrainSettings.model_validate(yaml.safe_load(printed)) == TrainSettings()


def test_windows_are_trained_on_the_command_line(tmp_path: Path, call: Call) -> None:
    out, settings = tmp_path / "own.json", tmp_path / "small.yaml"
    settings.write_text("epochs: 1\nframes: 2\n")
    code, _, text = call("train-windows", SAMPLE, "--out", out, "--config", settings, "--seed", 2)
    assert code == 0
    assert re.search(r"pose -?\d+\.\d\d -> .*, held out .*, (no )?better", text)
    network = load_window_network(out)
    assert "seed 2" in network.how and "3 cameras" in network.how
    # Its own file may be replaced, and begun with; another one may not.
    given = ("--out", tmp_path / "next.json", "--config", settings)
    assert call("train-windows", SAMPLE, *given, "--from", out)[0] == 0
    other = tmp_path / "mine.json"
    other.write_text("{}")
    for arguments, message in (
        ((SAMPLE, "--out", other), "was not written by calibgraph train-windows"),
        ((SAMPLE, "--out", out, "--from", out), "is read by this command"),
        ((SAMPLE, "--out", tmp_path / "a.json", "--from", other), "key '\\w+' is missing"),
        ((SAMPLE, "--out", tmp_path / "a.pt"), ".json"),
        ((SAMPLE, "--out", tmp_path / "a.json", "--config", other.with_name("no.yaml")), "no such"),
        ((tmp_path / "nothing", "--out", tmp_path / "a.json"), "nothing"),
    ):
        code, _, line = call("train-windows", *arguments)
        assert code == 2 and line.count("\n") == 1
        assert re.search(message, line), line
    assert PACKAGE_FILE.read_bytes() != out.read_bytes()
