"""Where draws come from: simulated scenarios and recordings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.paper.sources import Recorded, source_from
from calibgraph import preset


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
    rigs = Recorded((tmp_path,)).references
    assert list(rigs) == ["K^-1 P[:,3] (right)", "P[0,3]/fx only"]
    full, along_x = (rig.T_camera_lidar["image_2"][:3, 3] for rig in rigs.values())
    # K^-1 P[:,3] by hand: z = 0.01, x = (350 - 600 z) / 700, y = (7 - 180 z) / 700.
    np.testing.assert_allclose(full, [344 / 700, 5.2 / 700, 0.01])
    np.testing.assert_allclose(along_x, [0.5, 0.0, 0.0], atol=1e-12)
