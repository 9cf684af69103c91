from __future__ import annotations

import numpy as np
import pytest

import calibgraph
from calibgraph.matching.structure import prepared_image
from calibgraph.matching.structure.frame_cache import FrameCache
from calibgraph.matching.structure.prepared_image import PreparedImage
from calibgraph.matching.structure.schedule import LEVELS
from calibgraph.model.rig import Camera
from tests.conftest import SAMPLE


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


def test_images_finer_than_the_finest_level_needs_are_reduced() -> None:
    """By whole pixels, which moves nothing; their logarithm changes by the rounding of gray."""
    camera = calibgraph.load_dataset(SAMPLE).rig.cameras["left"]
    stated = camera.model_dump()
    stated["intrinsics_px"] = {key: 10 * each for key, each in camera.intrinsics_px if each}
    stated |= {"width_px": 10 * camera.width_px, "height_px": 10 * camera.height_px}
    fine = Camera(**stated)
    rows, columns = np.indices((fine.height_px, fine.width_px))
    gray = (150 + 50 * np.sin(rows / 300) * np.cos(columns / 200)).astype(np.uint8)
    whole, reduced = PreparedImage(gray), PreparedImage.from_gray(gray, fine)
    assert reduced.nbytes * 4 == whole.nbytes
    (one, scale), (other, same) = (
        each.log_gray(fine, LEVELS[-1].step_rad, 1.0) for each in (whole, reduced)
    )
    np.testing.assert_array_equal(scale, same)
    assert np.abs(one - other).max() < 0.5 / gray.min()
    kept = PreparedImage.from_gray(gray[::10, ::10], camera)
    np.testing.assert_array_equal(kept.gray, gray[::10, ::10])
