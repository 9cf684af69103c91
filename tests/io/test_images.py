"""Images from disk: what is incomplete or of another size is refused by name."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibgraph import FileError, load_rig
from calibgraph.io.images import load_image
from tests.conftest import SAMPLE, make_camera


def test_truncated_and_wrong_images_are_named(tmp_path: Path) -> None:
    camera = load_rig(SAMPLE).cameras["left"]
    jpg = Path(shutil.copy(SAMPLE / "cameras" / "left" / "000000.jpg", tmp_path))
    image = cv2.imread(str(jpg))
    png = tmp_path / "image.png"
    cv2.imwrite(str(png), image)
    np.testing.assert_array_equal(load_image(png, camera), image)
    for path in (jpg, png):
        data = path.read_bytes()
        for part in (data[: len(data) // 2], data[:-5], b"", b"no image at all"):
            path.write_bytes(part)
            with pytest.raises(FileError, match=path.name):
                load_image(path, camera)
    cv2.imwrite(str(png), image[:, :-2])
    with pytest.raises(FileError, match=r"is 638x360 px, the rig says 640x360 px"):
        load_image(png, camera)


def test_an_image_that_16_bits_make_black_is_named(tmp_path: Path) -> None:
    camera = make_camera()
    path = tmp_path / "dark.png"
    cv2.imwrite(str(path), np.full((camera.height_px, camera.width_px), 200, np.uint16))
    with pytest.raises(FileError, match="16 bits, of which only the lower 8"):
        load_image(path, camera)
