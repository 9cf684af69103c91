"""Folders of frames: clouds and images pair up, or the odd file is named."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from calibgraph import DatasetError, FileError, load_dataset
from tests.conftest import SAMPLE


@pytest.fixture
def sample(tmp_path: Path) -> Path:
    return Path(shutil.copytree(SAMPLE, tmp_path / "sample"))


def test_frames_must_pair_up(sample: Path) -> None:
    (sample / "cameras" / "left" / "000003.jpg").unlink()
    with pytest.raises(DatasetError, match=r"'000003' has a cloud but no image of camera 'left'"):
        load_dataset(sample)
    (sample / "lidar" / "000003.npy").unlink()
    with pytest.raises(DatasetError, match=r"'000003' has an image of camera '\w+' but no cloud"):
        load_dataset(sample)


def test_missing_folders_are_named(sample: Path, tmp_path: Path) -> None:
    with pytest.raises(FileError, match="no such folder"):
        load_dataset(tmp_path / "nothing")
    shutil.rmtree(sample / "cameras" / "left")
    with pytest.raises(
        FileError, match=r"no images of the rig's camera 'left'; it has front_left, front_right"
    ):
        load_dataset(sample)
    shutil.rmtree(sample / "lidar")
    with pytest.raises(FileError, match="lidar"):
        load_dataset(sample)


def test_a_frame_in_two_formats_is_ambiguous(sample: Path) -> None:
    shutil.copy(sample / "lidar" / "000000.npy", sample / "lidar" / "000000.bin")
    with pytest.raises(FileError, match="the same frame"):
        load_dataset(sample)
