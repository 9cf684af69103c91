"""KITTI odometry sequences: the extrinsics of ``calib.txt``."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from calibgraph import FileError, load_dataset, load_rig
from tests.conftest import make_camera
from tests.io.kitti_files import written_kitti


def test_kitti_extrinsics_use_the_whole_fourth_column(tmp_path: Path) -> None:
    rig = load_rig(written_kitti(tmp_path / "00"))
    assert list(rig.cameras) == ["image_2", "image_3"]
    Tr = make_camera((0.27, 0.0, -0.08)).T_camera_lidar
    for k in (2, 3):
        expected = Tr.copy()
        expected[:3, 3] += [-0.5 * k, 0.01 * k, 0.002 * k]
        np.testing.assert_allclose(rig.T_camera_lidar[f"image_{k}"], expected, atol=1e-12)
    assert (rig.cameras["image_2"].width_px, rig.cameras["image_2"].height_px) == (1226, 370)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("P2: 0 0 0 0 0 0 0 0 0 0 0 0", "P2: is no camera matrix"),
        ("P2: -7 0 6 0 0 7 2 0 0 0 1 0", "P2: is no camera matrix"),
        ("P2: 1400 0 1200 0 0 1400 360 0 0 0 2 0", "undo its scale: divide by 2"),
        ("P2: 700 80 600 0 0 700 180 0 0 0 1 0", "its skew is 80 px"),
        ("P3: 700 0 600 0 0 700 180 0 0 0 1 0\nP3: 7 0 6 0 0 7 2 0 0 0 1 0", "P3 is given twice"),
        ("P2: nan 0 6 0 0 7 2 0 0 0 1 0", "line 'P2' has 12 numbers, expected 12 finite"),
        ("Tr: 1 0 0 0 0 1 0 0 0 0 -1 0", "P2 and the LiDAR's pose: T_camera_lidar"),
        ("Tr: 1 0 0", "line 'Tr' has 3 numbers, expected 12"),
        ("\xff\xfe", "is not UTF-8"),
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


def test_a_camera_without_its_line_is_left_out_with_a_note(tmp_path: Path) -> None:
    folder = written_kitti(tmp_path / "00")
    path = folder / "calib.txt"
    lines = [line for line in path.read_text().splitlines() if not line.startswith("P3")]
    path.write_text("\n".join(lines))
    data = load_dataset(folder)
    assert list(data.rig.cameras) == ["image_2"]
    assert data.notes == (f"{path}: line 'P3' is missing: camera 'image_3' is left out",)
