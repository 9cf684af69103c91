from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import calibgraph
from calibgraph.matching.structure import frame_cache, prepared_image
from calibgraph.matching.structure.frame_cache import FrameCache
from tests.conftest import SAMPLE


def test_the_cache_holds_the_kept_frames_in_their_last_version(tmp_path: Path) -> None:
    data = calibgraph.load_dataset(SAMPLE)
    camera = data.rig.cameras["left"]
    path = tmp_path / "image.png"
    cv2.imwrite(str(path), np.full((camera.height_px, camera.width_px), 100, np.uint8))
    frame = replace(data.frames[0], image_paths={"left": path})
    cache = FrameCache()
    assert cache.image(frame, "left", camera).gray.mean() == 100
    cv2.imwrite(str(path), np.zeros((camera.height_px, camera.width_px), np.uint8))
    assert cache.image(frame, "left", camera).gray.mean() == 0
    cloud = cache.cloud(frame)
    cache.keep_only([frame])
    assert cache.cloud(frame) is cloud
    cache.keep_only(data.frames[1:])
    assert cache.cloud(frame) is not cloud


def test_an_image_is_scaled_once_for_each_size(monkeypatch: pytest.MonkeyPatch) -> None:
    data, cache = calibgraph.load_dataset(SAMPLE), FrameCache()
    camera = data.rig.cameras["left"]
    image, other = (cache.image(frame, "left", camera) for frame in data.frames[:2])
    small, scale = image.log_gray(camera, 0.02, 1.0)
    assert small.shape == (round(scale[1] * camera.height_px), round(scale[0] * camera.width_px))
    assert image.log_gray(camera, 0.02, 1.0)[0] is small
    assert image.log_gray(camera, 0.01, 1.0)[0].shape > small.shape
    assert (other.log_gray(camera, 0.02, 1.0)[0] != small).any()
    np.testing.assert_array_equal(image.mirrored().gray, image.gray[:, ::-1])
    monkeypatch.setattr(prepared_image, "MAX_BYTES", small.nbytes)
    assert other.log_gray(camera, 0.02, 1.0)[0].shape == small.shape
    assert image.log_gray(camera, 0.02, 1.0)[0] is not small
    cache.keep_only(data.frames[2:])
    assert not image.smaller.values()


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
