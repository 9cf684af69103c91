"""Two cameras with one device's images are told from two that see the same."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

import calibgraph
from calibgraph import Dataset, DatasetError, dataset_from_arrays
from calibgraph.matching.same_images import find_same_images, require_different_images
from calibgraph.progress import no_progress
from calibgraph.rounds import match_in_rounds
from tests.conftest import SAMPLE, Call

Image = np.ndarray
SIZE = (640, 360)


def compressed(image: Image) -> Image:
    return np.asarray(cv2.imdecode(cv2.imencode(".jpg", image, [1, 20])[1], cv2.IMREAD_COLOR))


def brighter(image: Image) -> Image:
    return np.asarray(255 * (image / 255) ** 0.6, np.uint8)


def cropped(image: Image) -> Image:
    return cv2.resize(image[36:324, 64:576], SIZE)


def scaled(image: Image) -> Image:
    return cv2.resize(cv2.resize(image, (320, 180)), SIZE)


def turned(image: Image) -> Image:
    return image[::-1, ::-1]


def noisy(image: Image) -> Image:
    noise = np.random.default_rng(0).normal(0, 10, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def as_it_is(image: Image) -> Image:
    return image


def copied(change: Callable[[Image], Image], delay: int = 0) -> Dataset:
    """The sample, whose front_right has changed images of front_left, some frames later."""
    data = calibgraph.load_dataset(SAMPLE)
    images = {
        name: [frame.load_image(name, camera) for frame in data.frames]
        for name, camera in data.rig.cameras.items()
    }
    own = images["front_left"]
    shown = [change(own[max(0, number - delay)]) for number in range(len(own))]
    return dataset_from_arrays(
        data.rig, [frame.load_cloud() for frame in data.frames], images | {"front_right": shown}
    )


@pytest.mark.parametrize(
    ("change", "delay"),
    [
        (as_it_is, 0), (compressed, 0), (brighter, 0), (cropped, 0), (scaled, 0), (turned, 0),
        (noisy, 0), (compressed, 1),
    ],
)  # fmt: skip
def test_copies_are_named_also_changed_or_a_frame_apart(
    change: Callable[[Image], Image], delay: int
) -> None:
    data = copied(change, delay)
    (line,) = find_same_images(data, data.rig)
    assert {"front_left", "front_right"} <= {*line.replace(",", " ").split()}
    assert ("a frame apart" in line) == (delay != 0)


def test_cameras_that_see_the_same_are_not_accused() -> None:
    data = calibgraph.load_dataset(SAMPLE)
    assert not find_same_images(data, data.rig)
    require_different_images(data, data.rig)


def test_what_cannot_be_compared_is_not_accused() -> None:
    blank = copied(np.zeros_like)
    assert not find_same_images(blank, blank.rig)


def test_nothing_is_searched_for_in_the_same_images() -> None:
    with pytest.raises(DatasetError, match="front_left and front_right have the same images"):
        match_in_rounds(copied(as_it_is), progress=no_progress)


@pytest.mark.parametrize(
    "command",
    [
        ("doctor", "DATA"),
        ("calibrate", "DATA", "--out", "OUT"),
        ("match", "DATA", "--out", "TABLE"),
        ("check", "RIG", "DATA"),
        ("track", "RIG", "DATA", "--matcher", "structure", "--out", "OUT"),
    ],
)
def test_every_command_names_them(command: tuple[str, ...], tmp_path: Path, call: Call) -> None:
    data = tmp_path / "data"
    shutil.copytree(SAMPLE, data)
    for path in (data / "cameras/front_left").iterdir():
        shutil.copy(path, data / "cameras/front_right")
    names = {
        "DATA": data,
        "RIG": data / "rig.yaml",
        "OUT": tmp_path / "out",
        "TABLE": tmp_path / "t.parquet",
    }
    code, printed, errors = call(*(str(names.get(word, word)) for word in command))
    assert code == (1 if command[0] == "doctor" else 2)
    words = " ".join((printed + errors).split())
    assert "front_left and front_right have the same images: one device under two names" in words
