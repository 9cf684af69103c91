"""The command ``simulate``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import calibgraph
from calibgraph import Rig, load_dataset
from calibgraph.simulation.scenarios import SCENARIOS, scenario_of
from tests.conftest import Call, make_camera


@pytest.mark.usefixtures("open3d")
@pytest.mark.slow
def test_command_writes_a_dataset_and_none_over_it(call: Call, tmp_path: Path) -> None:
    Rig(cameras={"front": make_camera()}).save(tmp_path / "own.yaml")
    options = "--rig", tmp_path / "own.yaml", "--frames", 1, "--beams", 16
    code, _, errors = call("simulate", "street", *options, "--out", tmp_path / "made")
    assert (code, "rig.yaml: written" in errors) == (0, True)
    assert len(load_dataset(tmp_path / "made").frames) == 1
    code, _, errors = call("simulate", "street", *options, "--out", tmp_path / "made")
    assert code == 2
    assert "is there already" in errors


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("street", "--rig", "nosuch"),
            "known are kitti, walkley, surround, fisheye, omni, panorama, sample",
        ),
        (("nowhere",), "unknown scenario 'nowhere'; known are street"),
        (("street", "--beams", 3), "3 beams"),
    ],
)
def test_command_refuses_in_one_line(
    call: Call, tmp_path: Path, arguments: tuple[object, ...], message: str
) -> None:
    code, _, errors = call("simulate", *arguments, "--out", tmp_path / "out")
    assert code == 2
    assert message in errors
    assert errors.count("\n") == 1


@pytest.mark.parametrize("name", SCENARIOS)
def test_the_command_writes_a_table_and_a_guess_that_is_off(
    name: str, tmp_path: Path, call: Call
) -> None:
    folder = tmp_path / "sim"
    code, _, text = call("simulate", name, "--frames", 3, "--out", folder)
    assert code == 0, text
    table = calibgraph.load_correspondences(folder / "correspondences.parquet")
    truth = calibgraph.load_rig(folder / "reference.yaml")
    assert set(table.cameras) == set(truth.cameras) == set(scenario_of(name).rig.cameras)
    for name_, error in calibgraph.evaluate(
        calibgraph.load_rig(folder / "rig.yaml"), truth
    ).cameras.items():
        assert error.rotation_error_deg == pytest.approx(5, abs=1e-6), name_
    code, _, text = call("simulate", name, "--frames", 3, "--out", folder)
    assert code == 2 and "is there already" in text
    again = scenario_of(name).draw(3, 0)
    np.testing.assert_array_equal(again.pixels_px, table.pixels_px)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("nowhere",), "unknown scenario 'nowhere'; known are street, kitti"),
        (("kitti", "--frames", 0), "0 frames: expected 1 to"),
        (("walkley", "--rotation-deg", 200), "expected an angle within"),
        (("kitti", "--beams", 16, "--rig", "fisheye"), "--rig and --beams would change nothing"),
        (("walkley", "--step-m", 0), "--step-m would change nothing"),
        (("walkley", "--sensor-errors", 0), "--sensor-errors would change nothing"),
        (("walkley", "--vary-layout"), "--vary-layout would change nothing"),
        (("nowhere", "--beams", 16), "unknown scenario 'nowhere'"),
    ],
)
def test_wrong_arguments_are_one_line(
    arguments: tuple[object, ...], words: str, tmp_path: Path, call: Call
) -> None:
    code, _, text = call("simulate", *arguments, "--out", tmp_path / "out")
    assert code == 2 and words in text and len(text.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()
