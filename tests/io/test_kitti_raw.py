"""KITTI raw drives: frames by their names, extrinsics through the rectified frame."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibgraph import FileError, load_dataset, load_rig
from tests.io.written import BASELINES, CLOUD, RECTIFY, T_CAMERA0_LIDAR, text_of

WIDTH, HEIGHT = 1242, 375


def written_drive(date: Path, frames: int = 2) -> Path:
    drive = date / "2011_09_26_drive_0005_sync"
    K = np.array([[721.5, 0, 609.6], [0, 721.5, 172.9], [0, 0, 1]])
    lines = ["calib_time: 09-Jan-2012 13:57:47", text_of("R_rect_00", RECTIFY)]
    for number, shift in BASELINES.items():
        P = K @ np.column_stack([np.eye(3), shift])
        lines += [text_of(f"S_rect_{number}", np.array([WIDTH, HEIGHT])),
                  text_of(f"P_rect_{number}", P)]  # fmt: skip
        images = drive / f"image_{number}" / "data"
        images.mkdir(parents=True)
        for frame in range(frames):
            pixels = np.full((HEIGHT, WIDTH, 3), 50 + frame, np.uint8)
            cv2.imwrite(str(images / f"{frame:010}.png"), pixels)
    (date / "calib_cam_to_cam.txt").write_text("\n".join(lines))
    lines = ["calib_time: 15-Mar-2012 11:37:16", text_of("R", T_CAMERA0_LIDAR[:3, :3]),
             text_of("T", T_CAMERA0_LIDAR[:3, 3]), "delta_f: 0 0"]  # fmt: skip
    (date / "calib_velo_to_cam.txt").write_text("\n".join(lines))
    scans = drive / "velodyne_points" / "data"
    scans.mkdir(parents=True)
    for frame in range(frames):
        CLOUD.tofile(scans / f"{frame:010}.bin")
    return drive


def test_frames_and_extrinsics_are_those_of_the_drive(tmp_path: Path) -> None:
    data = load_dataset(written_drive(tmp_path))
    assert [frame.name for frame in data.frames] == ["0000000000", "0000000001"]
    np.testing.assert_array_equal(data.frames[1].load_cloud(), CLOUD)
    assert list(data.rig.cameras) == ["image_02", "image_03"]
    p_lidar = np.array([12.0, 1.5, -0.4, 1.0])
    rectified = RECTIFY @ (T_CAMERA0_LIDAR @ p_lidar)[:3]
    for number, shift in BASELINES.items():
        camera = data.rig.cameras[f"image_{number}"]
        assert (camera.width_px, camera.height_px) == (WIDTH, HEIGHT)
        assert camera.intrinsics_px.fx == 721.5
        found = (camera.T_camera_lidar @ p_lidar)[:3]
        np.testing.assert_allclose(found, rectified + shift, atol=1e-12)
        image = data.frames[1].load_image(f"image_{number}", camera)
        assert image[0, 0, 0] == 51


@pytest.mark.parametrize(
    ("file", "line", "message"),
    [
        ("calib_cam_to_cam.txt", "R_rect_00: 1 0 0", "line 'R_rect_00' has 3 numbers, expected 9"),
        ("calib_cam_to_cam.txt", "S_rect_02: 1392 512", "S_rect_02 1392x512"),
        ("calib_cam_to_cam.txt", "P_rect_03: a b", "line 'P_rect_03' has 0 numbers, expected 12"),
        ("calib_velo_to_cam.txt", "T: 0 nan 0", "line 'T' has 3 numbers, expected 3 finite ones"),
        ("calib_velo_to_cam.txt", "R: 1 0 0 0 1 0 0 0 -1", "P_rect_02 and the LiDAR's pose"),
    ],
)
def test_a_wrong_calibration_is_one_line(
    tmp_path: Path, file: str, line: str, message: str
) -> None:
    drive = written_drive(tmp_path)
    key = line.partition(":")[0]
    kept = [
        each for each in (tmp_path / file).read_text().splitlines() if each.split(":")[0] != key
    ]
    (tmp_path / file).write_text("\n".join([*kept, line]))
    with pytest.raises(FileError, match=re.escape(message)):
        load_rig(drive)


def test_a_missing_calibration_is_named(tmp_path: Path) -> None:
    drive = written_drive(tmp_path)
    (tmp_path / "calib_velo_to_cam.txt").unlink()
    with pytest.raises(FileError, match="calib_velo_to_cam.txt: no such file"):
        load_rig(drive)


def test_a_camera_without_calibration_or_images_is_left_out(tmp_path: Path) -> None:
    drive = written_drive(tmp_path)
    path = tmp_path / "calib_cam_to_cam.txt"
    whole = path.read_text()
    path.write_text("".join(line for line in whole.splitlines(True) if "P_rect_03" not in line))
    data = load_dataset(drive)
    assert list(data.rig.cameras) == ["image_02"]
    assert "line 'P_rect_03' is missing: camera 'image_03' is left out" in data.notes[0]
    path.write_text(whole)
    (drive / "image_00" / "data").mkdir(parents=True)
    data = load_dataset(drive)
    assert list(data.rig.cameras) == ["image_02", "image_03"]
    assert "camera 'image_00' is left out" in data.notes[0]


D = (-0.37, 0.2, 0.0005, -0.0002, -0.07)
"""k1, k2, p1, p2, k3 as of the drives of 2011-09-26, rounded."""


def extracted(drive: Path, *, late_ms: int = 20) -> Path:
    """The same drive as recorded: distorted images, text clouds, and stamps that go apart."""
    path = drive.parent / "calib_cam_to_cam.txt"
    lines = [line.replace("S_rect_", "S_rectified_") for line in path.read_text().splitlines()]
    for number, shift in BASELINES.items():
        lines += [f"S_{number}: {WIDTH} {HEIGHT}", f"S_rect_{number}: 1224 370"]
        lines += [text_of(f"K_{number}", np.array([[980.0, 0, 690], [0, 975, 247], [0, 0, 1]]))]
        lines += [text_of(f"D_{number}", np.array(D)), text_of(f"R_{number}", RECTIFY)]
        lines += [text_of(f"T_{number}", shift)]
        stamps = [f"2011-09-26 13:02:25.{100 * n + late_ms:03}000000" for n in range(-1, 1)]
        stamps = ["2011-09-26 13:02:24.9" + f"{late_ms:02}000000", stamps[1]]
        (drive / f"image_{number}" / "timestamps.txt").write_text("\n".join(stamps))
    path.write_text("\n".join(lines))
    scans = drive / "velodyne_points"
    for cloud in (scans / "data").glob("*.bin"):
        np.savetxt(cloud.with_suffix(".txt"), CLOUD, fmt="%.9g")
        cloud.unlink()
    (scans / "timestamps.txt").write_text(
        "2011-09-26 13:02:25.000000000\n2011-09-26 13:02:25.100000000"
    )
    return drive


def test_a_recorded_drive_has_distorted_lenses_and_goes_by_stamps(tmp_path: Path) -> None:
    """The second image is the nearest to the first cloud; the second cloud has none."""
    drive = extracted(written_drive(tmp_path))
    rig = load_rig(drive)
    p_lidar = np.array([12.0, 1.5, -0.4, 1.0])
    for number, shift in BASELINES.items():
        camera = rig.cameras[f"image_{number}"]
        assert camera.distortion == D
        assert (camera.intrinsics_px.fx, camera.intrinsics_px.fy) == (980.0, 975.0)
        expected = RECTIFY @ (T_CAMERA0_LIDAR @ p_lidar)[:3] + shift
        np.testing.assert_allclose((camera.T_camera_lidar @ p_lidar)[:3], expected, atol=1e-12)
    data = load_dataset(drive, frames="0")
    (frame,) = data.frames
    np.testing.assert_array_equal(frame.load_cloud(), CLOUD)
    assert frame.load_image("image_02", rig.cameras["image_02"])[0, 0, 0] == 51
    assert len(data.recorded) == 1  # the second cloud is 80 ms from any image


def test_wrong_stamps_and_rows_of_a_recorded_drive_are_named(tmp_path: Path) -> None:
    drive = extracted(written_drive(tmp_path))
    (drive / "velodyne_points" / "data" / "0000000000.txt").write_text("1 2 3 0.5\n1 2")
    data = load_dataset(drive, frames="0")
    with pytest.raises(FileError, match="cannot be read as rows of numbers"):
        data.frames[0].load_cloud()
    (drive / "image_02" / "timestamps.txt").write_text("yesterday")
    with pytest.raises(FileError, match="has not a stamp a line"):
        load_dataset(drive, frames="0")
