"""`calibrate` with the matcher cmrnext."""

import sys
from pathlib import Path

import pytest
import yaml

import calibgraph
from calibgraph import FileError, Rig, load_rig
from calibgraph.cli.settings import RareSettings, read_settings
from tests.conftest import SAMPLE, Call


def test_rare_settings_are_read_from_a_file(tmp_path: Path) -> None:
    values = {"stamps": "record", "sync_tolerance_s": 0.1, "device": "cpu",
              "iterations": 2, "half_resolution": True, "terms": "stage1"}  # fmt: skip
    assert values.keys() == RareSettings.model_fields.keys()
    config = tmp_path / "config.yaml"
    config.write_text(yaml.safe_dump(values))
    assert read_settings(config)[1].model_dump() == values
    config.write_text("iterations: true")
    with pytest.raises(FileError, match="iterations: expected no truth value"):
        read_settings(config)


@pytest.mark.slow
def test_untrained_weights_fail_on_the_command_line(tmp_path: Path, call: Call) -> None:
    from tests.matching.cmrnext.builders import good_content, saved

    weights = saved(tmp_path / "random.tar", good_content())
    rig, out = tmp_path / "rig.yaml", tmp_path / "out"
    left = load_rig(SAMPLE).cameras["front_left"]
    Rig(cameras={"front_left": left}).save(rig)
    config = tmp_path / "config.yaml"
    config.write_text("half_resolution: true\niterations: 2\n")
    files = ("--weights", weights) * 3
    code, _, text = call(
        "calibrate", SAMPLE, "--rig", rig, "--frames", "0:1", "--matcher", "cmrnext", *files,
        "--out", out, "--config", config,
    )  # fmt: skip
    assert code == 1
    assert "FAIL" in text
    table = calibgraph.load_correspondences(out / "correspondences.parquet")
    assert len(table.metadata["schedule"]) == 3
    assert table.metadata["half_resolution"] is True
    # The table alone can be solved again, without the network, with the same verdict.
    code, _, text = call("solve", rig, out / "correspondences.parquet", "--out", tmp_path / "o")
    assert code == 1 and "of a displaced start remains" in text


def test_missing_torch_is_reported_in_one_line(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in list(sys.modules):
        if name.startswith("calibgraph.matching.cmrnext"):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    code, _, line = call("match", SAMPLE, "--matcher", "cmrnext", "--weights", "iter1.tar")
    assert code == 2
    assert "pip install 'calibgraph[learned]'" in line and line.count("\n") == 1
