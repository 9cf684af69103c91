"""Folders of frames: clouds and images pair up, or the odd file is named."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
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
        FileError,
        match=r"no images of the rig's camera 'left'; it has front_left, front_right: give .* the "
        "same name, or remove the camera",
    ):
        load_dataset(sample)
    (sample / "lidar").rename(sample / "velodyne")
    with pytest.raises(
        FileError, match=r"lidar: no such folder; put the files \(\.npy.*folders cameras, velodyne"
    ):
        load_dataset(sample)


def test_an_empty_folder_is_told_what_it_lacks(sample: Path) -> None:
    for path in (sample / "lidar").iterdir():
        path.rename(path.with_suffix(".xyz"))
    with pytest.raises(FileError, match=r"no file of a known kind; write or convert to \.npy"):
        load_dataset(sample)


def test_frames_that_are_not_chosen_may_lack_images(sample: Path) -> None:
    (sample / "cameras" / "left" / "000003.jpg").unlink()
    (sample / "lidar" / "000005.npy").unlink()
    data = load_dataset(sample, frames="0,2,4")
    assert [frame.name for frame in data.frames] == ["000000", "000002", "000004"]
    assert data.neighbour(data.frames[1], 1) is None  # 000003 is not complete
    assert data.neighbour(data.frames[0], 1).name == "000001"
    with pytest.raises(DatasetError, match="'000003' has a cloud but no image of camera 'left'"):
        load_dataset(sample, frames="2:4")


def test_the_number_of_lonely_files_is_named_if_there_are_more(sample: Path) -> None:
    (sample / "cameras" / "left" / "000003.jpg").unlink()
    with pytest.raises(DatasetError, match=r"camera 'left'; give both"):
        load_dataset(sample)
    (sample / "cameras" / "left" / "000004.jpg").unlink()
    with pytest.raises(DatasetError, match=r"camera 'left', and 1 more do not pair up; give both"):
        load_dataset(sample)


def test_names_that_are_not_utf8_are_refused(sample: Path) -> None:
    (sample / "lidar" / "000000.npy").rename(sample / "lidar" / "\udcff.npy")
    with pytest.raises(FileError, match="not UTF-8; rename it"):
        load_dataset(sample)


def test_a_frame_in_two_formats_is_ambiguous(sample: Path) -> None:
    shutil.copy(sample / "lidar" / "000000.npy", sample / "lidar" / "000000.bin")
    with pytest.raises(FileError, match="the same frame"):
        load_dataset(sample)


def test_what_is_no_file_is_named_and_not_waited_for(sample: Path) -> None:
    """A pipe that nobody writes to would be read for ever."""
    image = sample / "cameras" / "left" / "000003.jpg"
    image.unlink()
    os.mkfifo(image)
    with pytest.raises(FileError, match=r"000003.jpg: is no file that can be read: a pipe"):
        load_dataset(sample)
    image.unlink()
    image.symlink_to(image)
    with pytest.raises(FileError, match=r"000003.jpg: "):
        load_dataset(sample)


def test_clouds_of_nuscenes_have_the_stem_of_their_images(sample: Path) -> None:
    """``NAME.pcd.bin``: five float32 a point."""
    for path in sorted((sample / "lidar").iterdir()):
        cloud = np.load(path)[:, :4].astype(np.float32)
        rows = np.column_stack([cloud, np.zeros(len(cloud), np.float32)])
        rows.tofile(path.with_name(f"{path.stem}.pcd.bin"))
        path.unlink()
    data = load_dataset(sample)
    assert [frame.name for frame in data.frames] == [f.name for f in load_dataset(SAMPLE).frames]
    np.testing.assert_array_equal(
        data.frames[0].load_cloud(), load_dataset(SAMPLE).frames[0].load_cloud()
    )
