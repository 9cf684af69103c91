"""Scenes: from trusted extrinsics only, split without overlap."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from calibgraph import Dataset, DatasetError, load_rig
from calibgraph.matching.cmrnext.training.scenes import load_trusted_dataset, split
from tests.conftest import SAMPLE


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


def test_frames_are_split_at_the_end(trusted: Dataset) -> None:
    (first,), (last,) = split([trusted])
    assert [f.index for f in first.frames] == [0, 1, 2, 3, 4]
    assert [f.index for f in last.frames] == [5]
    with pytest.raises(DatasetError, match="--held-out"):
        split([trusted.select("0")])
