from __future__ import annotations

from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest

from calibgraph import DatasetError, FileError, Rig, load_dataset, load_rig
from calibgraph.io.frame import twist_by_scans, twist_of_entry
from calibgraph.simulation.rigs import rig_of
from tests.conftest import SAMPLE
from tests.io.written import written_kitti


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


def test_a_folder_that_is_given_twice_is_refused(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(SAMPLE)
    for again in (SAMPLE, tmp_path / "link"):
        with pytest.raises(DatasetError, match="is given twice"):
            load_dataset([SAMPLE, again])


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


def test_neighbouring_clouds_show_the_motion(tmp_path: Path) -> None:
    """Scans of a room 0.1 s apart, 30 cm and 2 degrees on: exact but for their noise of 1 cm."""
    rng = np.random.default_rng(0)
    sides = rng.integers(0, 3, 20_000)
    room = rng.uniform([-20.0, -12.0, -2.0], [25.0, 15.0, 6.0], (20_000, 3))
    for axis, (low, high) in enumerate(((-20.0, 25.0), (-12.0, 15.0), (-2.0, 6.0))):
        own = sides == axis
        room[own, axis] = rng.choice([low, high], own.sum())
    twist = np.array([0.0, 0.0, np.radians(20.0), 3.0, 0.0, 0.0])
    rig = rig_of("kitti")
    folder = tmp_path / "drive"
    for number in (0, 1, 2, 4):  # 3 is missing
        T = gtsam.Pose3.Expmap(0.1 * number * twist).inverse().matrix()
        cloud = room @ T[:3, :3].T + T[:3, 3] + rng.normal(0, 0.01, room.shape)
        (folder / "lidar").mkdir(parents=True, exist_ok=True)
        np.save(folder / "lidar" / f"{number}.npy", cloud.astype(np.float32))
        for name, camera in rig.cameras.items():
            image = np.zeros((camera.height_px, camera.width_px, 3), np.uint8)
            (folder / "cameras" / name).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / "cameras" / name / f"{number}.png"), image)
    data = load_dataset(folder, rig, interval_s=0.1)
    for frame in data.frames:
        assert frame.twist_per_s is not None
        np.testing.assert_allclose(frame.twist_per_s[:3], twist[:3], atol=0.01)
        np.testing.assert_allclose(frame.twist_per_s[3:], twist[3:], atol=0.05)
        assert twist_of_entry(frame.entry()) == pytest.approx(frame.twist_per_s)
    assert load_dataset(folder, rig).frames[0].twist_per_s is None
    for wrong_s in (0.0, -0.1, 1e-300, 0.001, 100.0, np.inf, np.nan):
        with pytest.raises(ValueError, match="--interval-s .* 0.005 to 10 s apart"):
            load_dataset(folder, rig, interval_s=wrong_s)
    first = twist_by_scans(data.frames[0], [(data.frames[1], 0.005)])
    assert np.linalg.norm(first[3:]) == pytest.approx(60.0, abs=1.0)  # 0.3 m in 5 ms
    with pytest.raises(DatasetError, match=r"at 150 m/s, more than 100; .* --interval-s"):
        twist_by_scans(data.frames[0], [(data.frames[1], 0.002)])
    with pytest.raises(DatasetError, match="no neighbouring scan"):
        twist_by_scans(data.frames[0], [])
