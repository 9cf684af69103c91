"""The converter of KITTI-360, on a folder of its layout."""

from pathlib import Path

import cv2
import numpy as np

from calibgraph import load_dataset
from examples.datasets.kitti_360 import convert
from tests.io.written import CLOUD

DRIVE = "2013_05_28_drive_0000_sync"
# The camera 0.4 m ahead of the LiDAR, 0.1 m left and 0.2 m below it, looking ahead.
CAM_TO_VELO = "0 0 1 0.4 -1 0 0 0.1 0 -1 0 -0.2"


def test_a_drive_becomes_a_dataset(tmp_path: Path) -> None:
    calibration, scans = tmp_path / "calibration", tmp_path / "data_3d_raw" / DRIVE
    scans = scans / "velodyne_points" / "data"
    for folder in (calibration, scans):
        folder.mkdir(parents=True)
    lens = (
        "S_rect_00: 64 48\nR_rect_00: 1 0 0 0 1 0 0 0 1\nP_rect_00: 55 0 32 0 0 55 24 0 0 0 1 0\n"
    )
    (calibration / "perspective.txt").write_text(f"calib_time: 9\n{lens}")
    (calibration / "calib_cam_to_velo.txt").write_text(CAM_TO_VELO)
    images = tmp_path / "data_2d_raw" / DRIVE / "image_00" / "data_rect"
    images.mkdir(parents=True)
    for frame in range(3):
        CLOUD.tofile(scans / f"{frame:010}.bin")
        if frame:  # the first has no image
            cv2.imwrite(str(images / f"{frame:010}.png"), np.full((48, 64, 3), frame, np.uint8))
    convert(tmp_path, DRIVE, tmp_path / "out")
    data = load_dataset(tmp_path / "out")
    assert [frame.name for frame in data.frames] == ["0000000001", "0000000002"]
    np.testing.assert_array_equal(data.frames[0].load_cloud(), CLOUD)
    seen = data.rig.T_camera_lidar["image_00"] @ [10.4, -0.9, -2.2, 1.0]
    np.testing.assert_allclose(seen[:3], [1.0, 2.0, 10.0], atol=1e-9)
