from __future__ import annotations

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibgraph import DatasetError, FileError, Rig, load_dataset, load_rig
from calibgraph.io.clouds import load_cloud
from calibgraph.io.images import load_image
from tests.conftest import SAMPLE, make_camera

CLOUD = np.random.default_rng(0).normal(size=(500, 4)).astype(np.float32)


def written_kitti(folder: Path, frames: int = 2) -> Path:
    """A KITTI odometry sequence with two cameras and known numbers."""
    (folder / "velodyne").mkdir(parents=True)
    K = np.array([[700.0, 0, 600], [0, 700, 180], [0, 0, 1]])
    lines = []
    for k in range(4):
        b = np.array([[-0.5 * k], [0.01 * k], [0.002 * k]])
        lines.append(f"P{k}: " + " ".join(map(str, (K @ np.hstack([np.eye(3), b])).ravel())))
    Tr = np.hstack([make_camera((0.27, 0.0, -0.08)).T_camera_lidar[:3]])
    lines.append("Tr: " + " ".join(map(str, Tr.ravel())))
    (folder / "calib.txt").write_text("\n".join(lines))
    for k in (2, 3):
        (folder / f"image_{k}").mkdir()
        for i in range(frames):
            image = np.full((370, 1226, 3), 40 * k, np.uint8)
            cv2.imwrite(str(folder / f"image_{k}" / f"{i:06}.png"), image)
    for i in range(frames):
        CLOUD.tofile(folder / "velodyne" / f"{i:06}.bin")
    return folder


@pytest.fixture
def sample(tmp_path: Path) -> Path:
    return Path(shutil.copytree(SAMPLE, tmp_path / "sample"))


def test_the_sample_is_read() -> None:
    data = load_dataset(SAMPLE)
    assert list(data.rig.cameras) == ["front_left", "front_right", "left"]
    assert [frame.name for frame in data.frames] == [f"{i:06}" for i in range(6)]
    frame = data.frames[0]
    assert frame.load_cloud().shape[1] == 4
    camera = data.rig.cameras["left"]
    assert frame.load_image("left", camera).shape == (camera.height_px, camera.width_px, 3)


def test_kitti_extrinsics_use_the_whole_fourth_column(tmp_path: Path) -> None:
    rig = load_rig(written_kitti(tmp_path / "00"))
    assert list(rig.cameras) == ["image_2", "image_3"]
    Tr = make_camera((0.27, 0.0, -0.08)).T_camera_lidar
    for k in (2, 3):
        expected = Tr.copy()
        expected[:3, 3] += [-0.5 * k, 0.01 * k, 0.002 * k]
        np.testing.assert_allclose(rig.T_camera_lidar[f"image_{k}"], expected, atol=1e-12)
    assert (rig.cameras["image_2"].width_px, rig.cameras["image_2"].height_px) == (1226, 370)


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


def test_truncated_and_wrong_images_are_named(sample: Path) -> None:
    camera = load_rig(SAMPLE).cameras["left"]
    jpg = sample / "cameras" / "left" / "000000.jpg"
    image = cv2.imread(str(jpg))
    png = sample / "image.png"
    cv2.imwrite(str(png), image)
    np.testing.assert_array_equal(load_image(png, camera), image)
    for path in (jpg, png):
        data = path.read_bytes()
        for part in (data[: len(data) // 2], data[:-5], b"", b"no image at all"):
            path.write_bytes(part)
            with pytest.raises(FileError, match=path.name):
                load_image(path, camera)
    cv2.imwrite(str(png), image[:, :-2])
    with pytest.raises(FileError, match=r"is 638x360 px, the rig says 640x360 px"):
        load_image(png, camera)


def test_npy_and_bin_clouds_are_read(tmp_path: Path) -> None:
    np.save(tmp_path / "four.npy", CLOUD)
    np.save(tmp_path / "three.npy", CLOUD[:, :3].astype(np.float64))
    CLOUD.tofile(tmp_path / "four.bin")
    np.testing.assert_array_equal(load_cloud(tmp_path / "four.npy"), CLOUD)
    np.testing.assert_array_equal(load_cloud(tmp_path / "four.bin"), CLOUD)
    three = load_cloud(tmp_path / "three.npy")
    np.testing.assert_array_equal(three[:, :3], CLOUD[:, :3])
    assert np.isnan(three[:, 3]).all()


def test_rows_without_a_return_are_left_out(tmp_path: Path) -> None:
    organised = CLOUD.copy()
    organised[::5, :3] = np.nan
    np.save(tmp_path / "cloud.npy", organised)
    assert len(load_cloud(tmp_path / "cloud.npy")) == 400


def test_bad_clouds_are_named(tmp_path: Path) -> None:
    good = tmp_path / "good.npy"
    np.save(good, CLOUD)
    partly = CLOUD.copy()
    partly[7, 1] = np.inf
    np.save(tmp_path / "infinite.npy", partly)
    np.save(tmp_path / "flat.npy", CLOUD.ravel())
    np.save(tmp_path / "text.npy", np.array(["a", "b"]))
    np.save(tmp_path / "objects.npy", np.array([{}, None], dtype=object), allow_pickle=True)
    np.save(tmp_path / "nothing.npy", np.full((3, 4), np.nan))
    (tmp_path / "truncated.npy").write_bytes(good.read_bytes()[:-100])
    (tmp_path / "empty.npy").write_bytes(b"")
    (tmp_path / "odd.bin").write_bytes(b"12345")
    (tmp_path / "empty.bin").write_bytes(b"")
    (tmp_path / "cloud.las").write_bytes(b"LASF")
    np.savez(tmp_path / "archive.npz", CLOUD)
    (tmp_path / "archive.npz").rename(tmp_path / "archive.npy")
    np.save(tmp_path / "transposed.npy", np.tile(CLOUD, (20, 1)).T)
    np.save(tmp_path / "origin.npy", np.zeros((100, 4)))
    for path in sorted(set(tmp_path.iterdir()) - {good}):
        with pytest.raises(FileError, match=path.name) as caught:
            load_cloud(path)
        assert "\n" not in str(caught.value)
    with pytest.raises(FileError, match=r"point 7 is not finite"):
        load_cloud(tmp_path / "infinite.npy")


@pytest.mark.parametrize("ascii_format", [True, False])
@pytest.mark.parametrize("suffix", [".pcd", ".ply"])
def test_pcd_and_ply_clouds_are_read_or_refused(
    suffix: str, ascii_format: bool, tmp_path: Path
) -> None:
    open3d = pytest.importorskip(
        "open3d", reason="open3d or a system library of it is missing", exc_type=ImportError
    )
    cloud = open3d.t.geometry.PointCloud(open3d.core.Tensor(CLOUD[:, :3].copy()))
    cloud.point["intensity"] = open3d.core.Tensor(CLOUD[:, 3:].copy())
    path = tmp_path / f"cloud{suffix}"
    open3d.t.io.write_point_cloud(str(path), cloud, write_ascii=ascii_format)
    np.testing.assert_allclose(load_cloud(path), CLOUD, rtol=1e-5, atol=1e-6)
    data = path.read_bytes()
    # Open3D itself reads half a file and fills up with what is in memory: that must not pass.
    for part in (data[: len(data) // 2], data[:-30], data[:60], b""):
        path.write_bytes(part)
        with pytest.raises(FileError, match=path.name):
            load_cloud(path)


def test_a_rig_from_outside_replaces_the_datasets(pair: Rig) -> None:
    with pytest.raises(FileError, match="no images of the rig's camera 'right'"):
        load_dataset(SAMPLE, pair)
    one = load_rig(SAMPLE)
    one = one.model_copy(update={"cameras": {"left": one.cameras["left"]}})
    assert list(load_dataset(SAMPLE, one).frames[0].image_paths) == ["left"]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("P2: 0 0 0 0 0 0 0 0 0 0 0 0", "P2 is no projection matrix"),
        ("P2: -7 0 6 0 0 7 2 0 0 0 1 0", "P2 is no projection matrix"),
        ("P2: nan 0 6 0 0 7 2 0 0 0 1 0", "P2 is no projection matrix"),
        ("Tr: 1 0 0 0 0 1 0 0 0 0 -1 0", "P2 and Tr: T_camera_lidar"),
        ("Tr: 1 0 0", "expected 12 numbers"),
        ("\xff\xfe", "is not a text file"),
    ],
)
def test_a_wrong_kitti_calibration_is_one_line(tmp_path: Path, line: str, said: str) -> None:
    folder = written_kitti(tmp_path / "00")
    path = folder / "calib.txt"
    key = line.partition(":")[0]
    kept = [other for other in path.read_text().splitlines() if not other.startswith(key)]
    path.write_bytes("\n".join([*kept, line]).encode("latin-1"))
    with pytest.raises(FileError, match=re.escape(said)) as caught:
        load_dataset(folder)
    assert "\n" not in str(caught.value)


def test_an_image_that_16_bits_make_black_is_named(tmp_path: Path) -> None:
    camera = make_camera()
    path = tmp_path / "dark.png"
    cv2.imwrite(str(path), np.full((camera.height_px, camera.width_px), 200, np.uint16))
    with pytest.raises(FileError, match="16 bits, of which only the lower 8"):
        load_image(path, camera)
