from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

import calibgraph
from calibgraph.matching.structure.frame_cache import FrameCache
from tests.conftest import SAMPLE


def test_the_cache_holds_the_kept_frames_in_their_last_version(tmp_path: Path) -> None:
    data = calibgraph.load_dataset(SAMPLE)
    camera = data.rig.cameras["left"]
    path = tmp_path / "image.png"
    cv2.imwrite(str(path), np.full((camera.height_px, camera.width_px), 100, np.uint8))
    frame = replace(data.frames[0], image_paths={"left": path})
    cache = FrameCache()
    assert cache.image(frame, "left", camera).mean() == 100
    cv2.imwrite(str(path), np.zeros((camera.height_px, camera.width_px), np.uint8))
    assert cache.image(frame, "left", camera).mean() == 0
    cloud = cache.cloud(frame)
    cache.keep_only([frame])
    assert cache.cloud(frame) is cloud
    cache.keep_only(data.frames[1:])
    assert cache.cloud(frame) is not cloud
