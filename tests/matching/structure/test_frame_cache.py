from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import calibgraph
from calibgraph.matching.structure import frame_cache
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


def test_the_frames_used_last_are_kept_up_to_a_size(monkeypatch: pytest.MonkeyPatch) -> None:
    data = calibgraph.load_dataset(SAMPLE)
    camera = data.rig.cameras["left"]
    cache = FrameCache()
    one, two, three = data.frames[:3]
    images = [cache.image(frame, "left", camera) for frame in (one, two)]
    clouds = [cache.cloud(frame) for frame in (one, two)]
    monkeypatch.setattr(frame_cache, "MAX_IMAGE_BYTES", 2 * images[0].nbytes)
    monkeypatch.setattr(frame_cache, "MAX_CLOUD_BYTES", 2.5 * clouds[0].nbytes)
    cache.image(three, "left", camera)
    cache.cloud(three)
    assert cache.image(two, "left", camera) is images[1]
    assert cache.cloud(two) is clouds[1]
    assert cache.image(one, "left", camera) is not images[0]
    assert cache.cloud(one) is not clouds[0]
