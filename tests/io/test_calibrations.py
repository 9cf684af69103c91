"""Results from disk: a file with a wrong part is refused when it is read, in one line."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from calibgraph import FileError, load_calibration
from tests.conftest import CommandRun

WRONG: dict[str, Any] = {
    "covariance": {"left": [[1.0]]},
    "joint_covariance": [[1.0]],
    "bootstrap_covariance": {"left": [[float("nan")] * 6] * 6},
    "stage1_T_camera_lidar": {"left": [[1.0]]},
    "camera_verdicts": {},
    "residuals": {"left": {"median_px": "large"}},
    "weaknesses": {"left": 5},
    "frames_used": [1, 2],
    "rounds": [["a"]],
    "counts": {"left": {"used": "many"}},
    "timings_s": {"solve": "long"},
    "terms": "all",
    "prior_share": {"left": "half"},
    "inputs": 3,
    "versions": [1],
    "config": [1],
    "rig": 5,
}


@pytest.mark.parametrize("key", WRONG)
def test_a_wrong_part_is_named(key: str, calibrated_sample: CommandRun, tmp_path: Path) -> None:
    path = Path(shutil.copy(calibrated_sample.folder / "calibration.yaml", tmp_path))
    content = yaml.safe_load(path.read_text())
    path.write_text(yaml.safe_dump({**content, key: WRONG[key]}, sort_keys=False))
    with pytest.raises(FileError, match=key) as caught:
        load_calibration(path)
    assert "\n" not in str(caught.value)


def test_a_missing_part_is_named(calibrated_sample: CommandRun, tmp_path: Path) -> None:
    path = Path(shutil.copy(calibrated_sample.folder / "calibration.yaml", tmp_path))
    content = yaml.safe_load(path.read_text())
    del content["covariance"]
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    with pytest.raises(FileError, match="'covariance' is missing"):
        load_calibration(path)
