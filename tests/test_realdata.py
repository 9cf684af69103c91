"""Real sensor data: the figures that the README gives. Minutes; skipped where the data are not."""

from __future__ import annotations

from pathlib import Path

import pytest

import calibgraph
from calibgraph import Calibration, Rig
from calibgraph.cmrnext.variant import Variant
from tests.conftest import Call
from tests.test_cmrnext_checkpoint import good_content, saved

pytestmark = pytest.mark.realdata


def sequences(realdata: Path, names: str) -> list[Path]:
    return [realdata / "kitti_odometry" / "sequences" / name for name in names.split("+")]


def calibrated(folders: list[Path], seed: int) -> tuple[Calibration, Rig]:
    """A calibration from 2 deg and 0.2 m off, and the reference, which only judges."""
    reference = calibgraph.load_rig(folders[0])
    start = calibgraph.perturb(reference, rotation_deg=2, translation_m=0.2, seed=seed)
    return calibgraph.calibrate(folders, start), reference


@pytest.mark.parametrize("names", ["00", "05", "06+07+08"])
def test_kitti_is_calibrated_from_2_deg_and_20_cm(realdata: Path, names: str) -> None:
    seeds = range(10) if names in ("00", "05") else range(3)
    good = 0
    for seed in seeds:
        result, reference = calibrated(sequences(realdata, names), seed)
        errors = calibgraph.evaluate(result.rig, reference).cameras.values()
        good += all(e.rotation_error_deg < 0.3 and e.translation_error_cm < 8 for e in errors)
    assert good >= 0.9 * len(seeds)


@pytest.mark.parametrize("names", ["01", "08"])
def test_poor_scenes_are_not_passed(realdata: Path, names: str) -> None:
    """A motorway with 3 frames, and one place with 4: results that are off do not say PASS."""
    for seed in range(3):
        result, reference = calibrated(sequences(realdata, names), seed)
        errors = calibgraph.evaluate(result.rig, reference).cameras
        for name, error in errors.items():
            if error.rotation_error_deg > 0.3 or error.translation_error_cm > 8:
                assert result.camera_verdicts[name].status != "PASS"


@pytest.mark.parametrize("name", ["surround6", "vlp16_distorted"])
def test_other_rigs_and_sensors_improve_in_rotation(realdata: Path, name: str) -> None:
    """Six cameras; 16 beams and a distorted lens. From the rig file's 2 deg and 0.2 m."""
    result = calibgraph.calibrate(realdata / name)
    reference = calibgraph.load_rig(realdata / name / "reference.yaml")
    for camera, error in calibgraph.evaluate(result.rig, reference).cameras.items():
        assert error.rotation_error_deg < 1.0, camera
    assert result.verdict.status != "PASS"  # 3 frames, or 8 of one spot with 16 beams


def test_untrained_networks_fail_on_real_frames(realdata: Path, tmp_path: Path, call: Call) -> None:
    """Their matches agree with each other and with the guess; the verdict is FAIL all the same."""
    weights = saved(tmp_path / "random.tar", good_content(Variant(width=16)))
    (folder,) = sequences(realdata, "07")
    for estimate in ("frame", "joint"):
        code, _, text = call(
            "calibrate", folder, "--frames", "0,1", "--matcher", "cmrnext",
            "--weights", weights, weights, "--estimate", estimate, "--half-resolution",
            "--out", tmp_path / estimate,
        )  # fmt: skip
        assert code == 1
        assert "of a displaced start remains" in text
        assert (tmp_path / estimate / "calibration.yaml").is_file()
