"""Frames of bags are those of the folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibgraph import load_dataset, load_rig
from tests.conftest import SAMPLE
from tests.io.bags.writing import KINDS, sample_bag


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("raw", [False, True])
def test_frames_of_a_bag_equal_those_of_the_folder(tmp_path: Path, kind: str, raw: bool) -> None:
    bag = sample_bag(tmp_path, kind, raw=raw)
    folder, data = load_dataset(SAMPLE), load_dataset(bag)
    assert list(data.rig.cameras) == list(folder.rig.cameras)
    for name, camera in load_rig(bag).cameras.items():
        given = folder.rig.cameras[name]
        assert camera.model_dump(exclude={"T_camera_lidar"}) == given.model_dump(
            exclude={"T_camera_lidar"}
        )
        np.testing.assert_allclose(camera.T_camera_lidar, given.T_camera_lidar, atol=1e-12)
    assert [frame.index for frame in data.frames] == list(range(len(folder.frames)))
    for found, expected in zip(data.frames, folder.frames, strict=True):
        np.testing.assert_array_equal(found.load_cloud(), expected.load_cloud())
        for name, camera in folder.rig.cameras.items():
            np.testing.assert_array_equal(
                found.load_image(name, camera), expected.load_image(name, camera)
            )
