from __future__ import annotations

from pathlib import Path

import pytest

from calibgraph import DatasetError, FileError, Rig, load_dataset, load_rig
from tests.conftest import SAMPLE
from tests.io.kitti_files import written_kitti


def test_the_sample_is_read() -> None:
    data = load_dataset(SAMPLE)
    assert list(data.rig.cameras) == ["front_left", "front_right", "left"]
    assert [frame.name for frame in data.frames] == [f"{i:06}" for i in range(6)]
    frame = data.frames[0]
    assert frame.load_cloud().shape[1] == 4
    camera = data.rig.cameras["left"]
    assert frame.load_image("left", camera).shape == (camera.height_px, camera.width_px, 3)


def test_several_sequences_are_one_problem(tmp_path: Path) -> None:
    folders = [written_kitti(tmp_path / name, frames) for name, frames in (("05", 2), ("06", 3))]
    data = load_dataset(folders)
    assert [frame.index for frame in data.frames] == [0, 1, 2, 3, 4]
    assert [frame.name for frame in data.frames] == [
        "05/000000", "05/000001", "06/000000", "06/000001", "06/000002",
    ]  # fmt: skip
    assert data.select("1:4").frames[-1].name == "06/000001"


def test_sequences_of_different_rigs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="its cameras differ"):
        load_dataset([written_kitti(tmp_path / "00"), SAMPLE])


@pytest.mark.parametrize(
    ("text", "indices"),
    [("0:6:2", [0, 2, 4]), (":2", [0, 1]), ("5", [5]), ("4,0", [4, 0]), ("-1:", [5]), ("-1", [5])],
)
def test_frames_are_selected(text: str, indices: list[int]) -> None:
    assert [frame.index for frame in load_dataset(SAMPLE).select(text).frames] == indices


@pytest.mark.parametrize("text", ["a", "9", "3:1", "", "1:2:3:4", "::0"])
def test_frames_that_are_not_there_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="frames"):
        load_dataset(SAMPLE).select(text)


def test_a_rig_from_outside_replaces_the_datasets(pair: Rig) -> None:
    with pytest.raises(FileError, match="no images of the rig's camera 'right'"):
        load_dataset(SAMPLE, pair)
    one = load_rig(SAMPLE)
    one = one.model_copy(update={"cameras": {"left": one.cameras["left"]}})
    assert list(load_dataset(SAMPLE, one).frames[0].image_paths) == ["left"]
