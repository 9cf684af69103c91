"""KITTI object folders: the frames of one calibration form a rig."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibgraph import FileError, load_dataset, load_rig
from tests.io.written import BASELINES, CLOUD, RECTIFY, T_CAMERA0_LIDAR, text_of

WIDTH, HEIGHT = 1242, 375
K = np.array([[721.5, 0, 609.6], [0, 721.5, 172.9], [0, 0, 1]])


def calibration(scale: float = 1.0) -> str:
    lines = [
        text_of(f"P{int(number)}", K @ np.column_stack([np.eye(3), scale * np.array(shift)]))
        for number, shift in BASELINES.items()
    ]
    lines += [text_of("R0_rect", RECTIFY), text_of("Tr_velo_to_cam", T_CAMERA0_LIDAR[:3])]
    return "\n".join(lines)


@pytest.fixture
def training(tmp_path: Path) -> Path:
    folder = tmp_path / "training"
    for name in ("calib", "velodyne", "image_2", "image_3"):
        (folder / name).mkdir(parents=True)
    for frame, scale in enumerate((2.0, 1.0, 1.0)):  # the first is of another day
        stem = f"{frame:06}"
        CLOUD.tofile(folder / "velodyne" / f"{stem}.bin")
        (folder / "calib" / f"{stem}.txt").write_text(calibration(scale))
        for name in ("image_2", "image_3"):
            pixels = np.full((HEIGHT, WIDTH, 3), 50 + frame, np.uint8)
            cv2.imwrite(str(folder / name / f"{stem}.png"), pixels)
    return folder


def test_the_frames_are_those_of_the_commonest_calibration(training: Path) -> None:
    data = load_dataset(training)
    assert [frame.name for frame in data.frames] == ["000001", "000002"]
    np.testing.assert_array_equal(data.frames[1].load_cloud(), CLOUD)
    assert any("the 2 of the commonest" in note for note in data.notes)
    p_lidar = np.array([12.0, 1.5, -0.4, 1.0])
    rectified = RECTIFY @ (T_CAMERA0_LIDAR @ p_lidar)[:3]
    for number, shift in BASELINES.items():
        camera = data.rig.cameras[f"image_{int(number)}"]
        assert (camera.width_px, camera.height_px) == (WIDTH, HEIGHT)
        found = (camera.T_camera_lidar @ p_lidar)[:3]
        np.testing.assert_allclose(found, rectified + shift, atol=1e-12)
        image = data.frames[1].load_image(f"image_{int(number)}", camera)
        assert image[0, 0, 0] == 52


def test_one_calibration_leaves_nothing_out(training: Path) -> None:
    (training / "calib" / "000000.txt").write_text(calibration())
    data = load_dataset(training)
    assert (len(data.frames), data.notes) == (3, ())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("R0_rect", "R0_rect: 1 0 0"), "line 'R0_rect' has 3 numbers, expected 9"),
        (("Tr_velo_to_cam", ""), "line 'Tr_velo_to_cam' is missing"),
        (
            ("P2", "P2: " + " ".join(["nan"] * 12)),
            "line 'P2' has 12 numbers, expected 12 fin",
        ),
    ],
)
def test_a_wrong_calibration_is_one_line(
    training: Path, change: tuple[str, str], message: str
) -> None:
    lines = [
        change[1] if line.startswith(change[0]) else line for line in calibration().split("\n")
    ]
    for path in (training / "calib").iterdir():
        path.write_text("\n".join(lines))
    with pytest.raises(FileError, match=re.escape(message)):
        load_rig(training)


def test_a_cloud_without_calibration_is_named(training: Path) -> None:
    (training / "calib" / "000002.txt").unlink()
    with pytest.raises(FileError, match="the cloud 000002 needs its calibration"):
        load_dataset(training)


def test_a_camera_without_its_line_is_left_out_with_a_note(training: Path) -> None:
    for path in (training / "calib").glob("*.txt"):
        lines = [line for line in path.read_text().splitlines() if not line.startswith("P3")]
        path.write_text("\n".join(lines))
    data = load_dataset(training)
    assert list(data.rig.cameras) == ["image_2"]
    assert "line 'P3' is missing: camera 'image_3' is left out" in data.notes[0]
