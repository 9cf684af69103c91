from __future__ import annotations

import numpy as np
import pytest

import calibgraph
from calibgraph.io import kept_frames
from calibgraph.io.kept_frames import KeptFrame, keep_frames
from calibgraph.matching.camera_pairs.features import Features, features_of
from calibgraph.matching.structure.frame_cache import FrameCache, cache_of
from tests.conftest import SAMPLE


def test_features_of_kept_frames_are_found_once_per_lens() -> None:
    data = calibgraph.load_dataset(SAMPLE)
    frame, camera = keep_frames(data).frames[0], data.rig.cameras["left"]
    found = features_of(frame, "left", camera)
    assert features_of(frame, "left", camera) is found
    other = camera.model_copy(
        update={"intrinsics_px": camera.intrinsics_px.model_copy(update={"fx": 500.0})}
    )
    assert not np.allclose(features_of(frame, "left", other).rays, found.rays)
    plain = features_of(data.frames[0], "left", camera)
    np.testing.assert_array_equal(plain.descriptors, found.descriptors)


def test_kept_frames_share_one_cache_of_windows() -> None:
    data, own = calibgraph.load_dataset(SAMPLE), FrameCache()
    kept = keep_frames(data)
    assert keep_frames(kept) is kept
    assert cache_of(kept.frames, own) is cache_of(kept.frames[2:], own) is not own
    assert cache_of(data.frames, own) is own
    assert cache_of(keep_frames(data).frames, own) is not cache_of(kept.frames, own)


def test_no_size_drops_the_cache_of_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept_frames, "MAX_BYTES", 1)
    data = keep_frames(calibgraph.load_dataset(SAMPLE))
    cache, camera = cache_of(data.frames, FrameCache()), data.rig.cameras["left"]
    images = [cache.image(frame, "left", camera) for frame in data.frames]
    assert cache_of(data.frames, FrameCache()) is cache
    for frame, image in zip(data.frames, images, strict=True):
        assert cache.image(frame, "left", camera) is image


def test_what_was_used_last_is_kept_up_to_a_size(monkeypatch: pytest.MonkeyPatch) -> None:
    frame, made = keep_frames(calibgraph.load_dataset(SAMPLE)).frames[0], list[str]()
    assert isinstance(frame, KeptFrame)
    monkeypatch.setattr(kept_frames, "MAX_BYTES", 2 * size(100))

    def derive(key: str) -> None:
        frame.derive(key, lambda: made.append(key) or of(100))

    for key in "aabacab":
        derive(key)
    assert "".join(made) == "abcb"


def of(rows: int) -> Features:
    return Features(np.zeros((rows, 2)), np.zeros((rows, 3)), np.zeros((rows, 128), np.float32))


def size(rows: int) -> int:
    return of(rows).nbytes
