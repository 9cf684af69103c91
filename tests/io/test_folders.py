"""Datasets in folders: clouds and images pair up, or the odd file is named."""

import gzip
import os
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest

from calibgraph import CalibrationError, DatasetError, FileError, Rig, load_dataset, load_rig
from calibgraph.io.bags import BagOptions
from calibgraph.io.dataset_folders import describe_pairing
from calibgraph.io.frame import frame_of_entry, twist_by_scans
from calibgraph.simulation.rigs import rig_of
from factors import displace
from tests.conftest import SAMPLE
from tests.io.written import written_kitti


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
        assert frame_of_entry(frame.entry()).twist_per_s == pytest.approx(frame.twist_per_s)
    assert load_dataset(folder, rig).frames[0].twist_per_s is None
    still = {frame.name: frame.load_cloud()[:, :3] for frame in data.frames}
    for name, cloud in still.items():  # as swept: what is ahead is farther in an earlier point
        timed = np.zeros(len(cloud), [(axis, "f4") for axis in "xyzt"])
        timed["t"] = np.linspace(0.0, 0.1, len(cloud))
        for axis, column in zip("xyz", displace(cloud, twist, 0.05 - timed["t"]).T, strict=True):
            timed[axis] = column
        np.save(folder / "lidar" / f"{name}.npy", timed)
    swept = load_dataset(folder, rig, interval_s=0.1)
    for frame in swept.frames:
        for one in (frame, frame_of_entry(frame.entry())):
            np.testing.assert_allclose(one.load_cloud()[:, :3], still[frame.name], atol=0.03)
    assert "corrected for motion by the times of their points" in " ".join(swept.notes)
    for wrong_s in (0.0, -0.1, 1e-300, 0.001, 100.0, np.inf, np.nan):
        with pytest.raises(ValueError, match="--interval-s .* 0.005 to 10 s apart"):
            load_dataset(folder, rig, interval_s=wrong_s)
    first = twist_by_scans(data.frames[0], [(data.frames[1], 0.005)])
    assert np.linalg.norm(first[3:]) == pytest.approx(60.0, abs=1.0)  # 0.3 m in 5 ms
    with pytest.raises(DatasetError, match=r"at 150 m/s, more than 100; .* --interval-s"):
        twist_by_scans(data.frames[0], [(data.frames[1], 0.002)])
    with pytest.raises(DatasetError, match="no neighbouring scan"):
        twist_by_scans(data.frames[0], [])


@pytest.fixture
def sample(tmp_path: Path) -> Path:
    return Path(shutil.copytree(SAMPLE, tmp_path / "sample"))


def remove(*names: str) -> Callable[[Path], None]:
    return lambda folder: [(folder / name).unlink() for name in names].clear()


def move(old: str, new: str) -> Callable[[Path], object]:
    return lambda folder: (folder / old).rename(folder / new)


def link_to_itself(folder: Path) -> None:
    (image := folder / LEFT_3).unlink()
    image.symlink_to(image)


def pipe(folder: Path) -> None:
    """A pipe that nobody writes to would be read for ever."""
    (folder / LEFT_3).unlink()
    os.mkfifo(folder / LEFT_3)


def other_suffixes(folder: Path) -> None:
    for path in (folder / "lidar").iterdir():
        path.rename(path.with_suffix(".xyz"))


LEFT_3, LEFT_4 = "cameras/left/000003.jpg", "cameras/left/000004.jpg"
ODD: list[tuple[Callable[[Path], object], str]] = [
    (remove(LEFT_3), r"'000003' has a cloud but no image of camera 'left'; give both"),
    (remove(LEFT_3, LEFT_4), r"camera 'left', and 1 more do not pair up; give both"),
    (remove("lidar/000003.npy"), r"'000003' has an image of camera '\w+' but no cloud"),
    (shutil.rmtree, "no such folder"),
    (lambda folder: shutil.rmtree(folder / "cameras" / "left"),
     r"no images of the rig's camera 'left'; it has front_left, front_right: give .* the same "
     "name, or remove the camera"),
    (move("lidar", "velodyne"),
     r"lidar: no such folder; put the files \(\.npy.*folders cameras, velodyne"),
    (other_suffixes, r"no file of a known kind; write or convert to \.npy"),
    (move("lidar/000000.npy", "lidar/\udcff.npy"), "not UTF-8; rename it"),
    (lambda folder: shutil.copy(folder / "lidar" / "000000.npy", folder / "lidar" / "000000.bin"),
     "the same frame"),
    (pipe, r"000003.jpg: is no file that can be read: a pipe"),
    (link_to_itself, r"000003.jpg: "),
]  # fmt: skip


@pytest.mark.parametrize(("change", "said"), ODD, ids=[said for _, said in ODD])
def test_what_is_odd_in_a_folder_is_named(
    change: Callable[[Path], object], said: str, sample: Path
) -> None:
    change(sample)
    with pytest.raises(CalibrationError, match=said) as caught:
        load_dataset(sample)
    assert "\n" not in str(caught.value)


def test_frames_that_are_not_chosen_may_lack_images(sample: Path) -> None:
    (sample / "cameras" / "left" / "000003.jpg").unlink()
    (sample / "lidar" / "000005.npy").unlink()
    data = load_dataset(sample, frames="0,2,4")
    assert [frame.name for frame in data.frames] == ["000000", "000002", "000004"]
    assert data.neighbour(data.frames[1], 1) is None  # 000003 is not complete
    assert data.neighbour(data.frames[0], 1).name == "000001"
    with pytest.raises(DatasetError, match="'000003' has a cloud but no image of camera 'left'"):
        load_dataset(sample, frames="2:4")


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


START_NS = 1_403_636_579_000_000_000


def at(frame: int, later_ms: float = 0.0) -> int:
    """The stamp of a frame of a recording at 2 Hz [ns]."""
    return START_NS + round((500 * frame + later_ms) * 1e6)


def renamed(folder: Path, cloud: Callable[[int], str], image: Callable[[int], str]) -> Path:
    """The sample with other names; an empty one takes the file away."""
    for path in [*folder.glob("lidar/*"), *folder.glob("cameras/*/*")]:
        name = (cloud if path.parent.name == "lidar" else image)(int(path.stem))
        path.rename(path.with_name(f"new{name}{path.suffix}")) if name else path.unlink()
    for path in [*folder.glob("lidar/*"), *folder.glob("cameras/*/*")]:
        path.rename(path.with_name(path.name.removeprefix("new")))
    return folder


@pytest.mark.parametrize(
    ("cloud", "image"),
    [
        (lambda i: f"{i + 8}", lambda i: f"{i + 8}"),
        (lambda i: f"drive1_{i + 8}", lambda i: f"drive1_{i + 8}"),
        (lambda i: f"{9 + 0.25 * i}", lambda i: f"{9 + 0.25 * i}"),
        (lambda i: f"{i + 8}", lambda i: f"{i + 8:06}"),
        (lambda i: f"scan_{i + 8}", lambda i: f"image{i + 8:03}"),
        (lambda i: f"{at(i)}", lambda i: f"{at(i, 4 + 3 * i)}"),
        (lambda i: f"{at(i) / 1e9:.6f}", lambda i: f"{at(i, 12)}"),
        (lambda i: f"{at(i) // 10**9}_{at(i) % 10**9:09}", lambda i: f"cam_{at(i, -20) // 1000}"),
        (lambda i: f"{at(i) // 10**6}", lambda i: f"{at(i, 20) // 10**6}"),
    ],
)
def test_frames_follow_the_numbers_in_names(
    cloud: Callable[[int], str], image: Callable[[int], str], sample: Path
) -> None:
    data = load_dataset(renamed(sample, cloud, image))
    assert [frame.name for frame in data.frames] == [cloud(i) for i in range(6)]
    for i, frame in enumerate(data.frames):
        assert {path.stem for path in frame.image_paths.values()} == {image(i)}


def test_files_that_stamps_do_not_pair_are_left_out_and_counted(sample: Path) -> None:
    renamed(
        sample,
        lambda i: str(at(i)) * (i != 2),  # noqa: PLR2004
        lambda i: str(at(i, 9)) * (i != 4),  # noqa: PLR2004
    )
    data = load_dataset(sample)
    assert [frame.index for frame in data.frames] == [0, 1, 2, 4]
    words = r"4 of 5 clouds .* within 0.05 s .* left \+9 ms .* 0.09 m at 10 m/s \(1 images not used"
    assert any(re.search(words, note) for note in data.notes)
    assert re.search(words, describe_pairing(sample))


@pytest.mark.parametrize(
    ("later_ms", "message"),
    [(80, r"\+80 ms \(median\), at most 80: 0.80 m at 10 m/s; give a larger sync_tol"),
     (1e9, r"clouds are from 1403636579.000 to .* images from 1404636579.000")],
)  # fmt: skip
def test_stamps_that_are_far_apart_are_named(later_ms: float, message: str, sample: Path) -> None:
    renamed(sample, lambda i: str(at(i)), lambda i: str(at(i, later_ms)))
    with pytest.raises(DatasetError, match=message):
        load_dataset(sample)
    if later_ms < 100:  # noqa: PLR2004
        assert len(load_dataset(sample, bag=BagOptions(sync_tolerance_s=0.1)).frames) == 6


def test_the_command_that_is_printed_unpacks_a_file(tmp_path: Path) -> None:
    packed = tmp_path / "a drive.npy.gz"
    packed.write_bytes(gzip.compress(b"content"))
    with pytest.raises(FileError, match="is compressed") as error:
        load_dataset(packed)
    command = str(error.value).split("`")[1]
    assert subprocess.run(command, shell=True, check=True).returncode == 0
    assert (tmp_path / "a drive.npy").read_bytes() == b"content"


def test_videos_and_clouds_of_other_programs_name_what_converts_them(sample: Path) -> None:
    shutil.rmtree(sample / "cameras" / "left")
    (sample / "cameras" / "left.mp4").write_bytes(b"")
    with pytest.raises(FileError, match=r"mkdir (\S+/left); ffmpeg -i \1.mp4 \1/%06d.png"):
        load_dataset(sample)
    for path in (sample / "lidar").iterdir():
        path.rename(path.with_suffix(".las"))
    with pytest.raises(FileError, match=r"pdal translate (\S+/000000).las \1.ply"):
        load_dataset(sample)
