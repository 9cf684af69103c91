"""Where draws come from: simulated scenarios and recordings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from calibgraph import preset
from calibgraph.evaluation.sources import Recorded, source_from
from calibgraph.io.kitti import load_kitti_rig
from tests.conftest import SAMPLE


def test_tuning_and_test_frames_are_kept_apart() -> None:
    one, two = source_from("kitti").halves(0)
    assert not np.array_equal(one.draw(1, 0).table.pixels_px, two.draw(1, 0).table.pixels_px)
    halves = source_from(str(SAMPLE)).halves(0)
    positions = [set(half.positions or ()) for half in halves if isinstance(half, Recorded)]
    assert positions[0] | positions[1] == set(range(6))
    assert not positions[0] & positions[1]


def test_stage_1_is_computed_once_per_draw() -> None:
    draw, config = source_from("kitti").draw(1, seed=0), preset("kitti")
    assert draw.stage1(config) is draw.stage1(config)
    fewer = replace(draw, table=draw.table.select(draw.table.confidence > 0.5))
    assert fewer.stage1(config) is not draw.stage1(config)


def test_both_interpretations_of_kittis_ground_truth(tmp_path: Path) -> None:
    P = "700 0 600 350 0 700 180 7 0 0 1 0.01"
    (tmp_path / "calib.txt").write_text(f"P2: {P}\nTr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    (tmp_path / "image_2").mkdir()
    cv2.imwrite(str(tmp_path / "image_2" / "0.png"), np.zeros((370, 1226), np.uint8))
    full = load_kitti_rig(tmp_path).T_camera_lidar["image_2"][:3, 3]
    along_x = load_kitti_rig(tmp_path, shift_along_x_only=True).T_camera_lidar["image_2"][:3, 3]
    # K^-1 P[:,3] by hand: z = 0.01, x = (350 - 600 z) / 700, y = (7 - 180 z) / 700.
    np.testing.assert_allclose(full, [344 / 700, 5.2 / 700, 0.01])
    np.testing.assert_allclose(along_x, [0.5, 0.0, 0.0])
    assert list(Recorded((tmp_path,)).references) == ["K^-1 P[:,3] (right)", "P[0,3]/fx only"]
