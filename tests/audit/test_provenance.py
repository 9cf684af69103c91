"""A check with the recording that made the calibration is named as one."""

from __future__ import annotations

from pathlib import Path

import pytest

from calibgraph import CalibrationError, load_dataset, load_rig
from calibgraph.audit.check import provenance
from tests.conftest import SAMPLE, CommandRun


def test_the_recording_of_a_result_is_known_by_its_content_wherever_it_lies(
    calibrated_sample: CommandRun, tmp_path: Path
) -> None:
    result, rig = calibrated_sample.folder, load_rig(SAMPLE / "rig.yaml")
    assert provenance(result, load_dataset(SAMPLE, rig)).same_recording
    other = tmp_path / "other"
    for source in SAMPLE.rglob("*"):
        if source.is_file():
            copy = other / source.relative_to(SAMPLE)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(source.read_bytes())
    assert provenance(result / "calibration.yaml", load_dataset(other, rig)).same_recording
    for cloud in load_dataset(other, rig).frames:  # the same names, other clouds
        cloud.cloud_path.write_bytes(cloud.cloud_path.read_bytes()[:-32])
    assert not provenance(result, load_dataset(other, rig)).same_recording


def test_a_rig_names_no_recording() -> None:
    rig = load_rig(SAMPLE / "rig.yaml")
    assert not provenance(SAMPLE / "rig.yaml", load_dataset(SAMPLE, rig)).same_recording


def test_a_result_of_mounts_is_refused(calibrated_sample: CommandRun, tmp_path: Path) -> None:
    text = (calibrated_sample.folder / "calibration.yaml").read_text("utf-8")
    assert "of: alignment" in text
    deployed = tmp_path / "calibration.yaml"
    deployed.write_text(text.replace("of: alignment", "of: mount"), "utf-8")
    data = load_dataset(SAMPLE, load_rig(SAMPLE / "rig.yaml"))
    with pytest.raises(CalibrationError, match=r"poses of the mount.*--of alignment"):
        provenance(deployed, data)
