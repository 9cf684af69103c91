"""Recordings to learn from: from trusted extrinsics only, split without overlap."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from calibgraph import Dataset, DatasetError, load_rig
from calibgraph.io.calibrations import load_calibration
from calibgraph.matching.trusted_data import load_trusted_dataset, split
from tests.conftest import SAMPLE, CommandRun


@pytest.fixture(scope="module")
def trusted() -> Dataset:
    return load_trusted_dataset(SAMPLE)


def test_the_reference_is_trusted_and_not_the_guess(trusted: Dataset, tmp_path: Path) -> None:
    truth = load_rig(SAMPLE / "reference.yaml").T_camera_lidar
    for name, T in trusted.rig.T_camera_lidar.items():
        np.testing.assert_array_equal(T, truth[name])
    folder = tmp_path / "data"
    shutil.copytree(SAMPLE, folder)
    (folder / "reference.yaml").unlink()
    with pytest.raises(DatasetError, match="rig.yaml is a guess"):
        load_trusted_dataset(folder)
    assert load_trusted_dataset(folder, trusted.rig).rig == trusted.rig


def test_a_result_is_trusted_where_it_is_pass(
    calibrated_sample: CommandRun, tmp_path: Path
) -> None:
    folder = calibrated_sample.folder
    result = load_calibration(folder)
    passed = {n for n, verdict in result.camera_verdicts.items() if verdict.status == "PASS"}
    assert passed
    data = load_trusted_dataset(folder)
    assert data.rig.cameras.keys() == passed and data.folders == (SAMPLE,)
    assert [frame.entry() for frame in data.frames] == list(result.frames)
    for name in passed:
        np.testing.assert_array_equal(
            data.rig.T_camera_lidar[name], result.rig.T_camera_lidar[name]
        )
    copy = tmp_path / "changed"
    shutil.copytree(folder, copy)
    content = yaml.safe_load((copy / "calibration.yaml").read_text())
    first = next(iter(content["inputs"]))
    content["inputs"] = {**content["inputs"], first: "0" * 64}
    (copy / "calibration.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(DatasetError, match="has changed since it was calibrated"):
        load_trusted_dataset(copy)


def test_frames_are_split_at_the_end(trusted: Dataset) -> None:
    (first,), (last,) = split([trusted])
    assert [f.index for f in first.frames] == [0, 1, 2, 3, 4]
    assert [f.index for f in last.frames] == [5]
    with pytest.raises(DatasetError, match="--held-out"):
        split([trusted.select("0")])
