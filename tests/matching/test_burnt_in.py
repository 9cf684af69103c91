"""What is drawn into images stands still, and is filled; the scene and what moves is not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

import calibgraph
from calibgraph import Dataset, dataset_from_arrays
from calibgraph.matching.burnt_in import describe_burnt_in, find_burnt_in, hide_burnt_in
from calibgraph.matching.camera_pairs.features import features_of, match_features
from tests.conftest import SAMPLE

Image = np.ndarray
PAIR = ("front_left", "left")  # which look 70 degrees apart


def text(image: Image, number: int) -> None:
    """A date, a time that changes, and a place."""
    line = f"2024-05-01 12:30:{11 + 7 * number} N47.{3771 + 13 * number}"
    cv2.putText(image, line, (8, 350), 0, 0.6, (255, 255, 255), 2)


def logo(image: Image, _: int) -> None:
    cv2.rectangle(image, (500, 300), (632, 352), (255, 255, 255), -1)
    cv2.putText(image, "LOGO", (508, 340), 0, 1.2, (0, 0, 0), 3)


def crosshair(image: Image, _: int) -> None:
    cv2.line(image, (280, 180), (360, 180), (0, 255, 0), 2)
    cv2.line(image, (320, 140), (320, 220), (0, 255, 0), 2)


def circle(image: Image, _: int) -> None:
    outside = np.ones(image.shape[:2], np.uint8)
    cv2.circle(outside, (320, 180), 300, 0, -1)
    image[outside > 0] = 0


def nothing(_: Image, __: int) -> None:
    """The images as they are."""


def drawn(draw: Callable[[Image, int], None], frames: slice = slice(None)) -> Dataset:
    """The sample with something drawn into the images of two cameras, which are compressed."""
    data = calibgraph.load_dataset(SAMPLE)
    rig = data.rig.model_copy(update={"cameras": {n: data.rig.cameras[n] for n in PAIR}})
    images: dict[str, list[Image]] = {name: [] for name in PAIR}
    for frame in data.frames[frames]:
        for name in PAIR:
            image = frame.load_image(name, rig.cameras[name]).copy()
            draw(image, frame.index)
            coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 50])[1]
            images[name].append(np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR)))
    return dataset_from_arrays(rig, [np.ones((5, 4))] * len(images["left"]), images)


@pytest.mark.parametrize(
    ("draw", "inside"),
    [
        (text, ((8, 334), (215, 350))),
        (logo, ((500, 300), (632, 352))),
        (crosshair, ((300, 178), (340, 182))),
        (circle, ((20, 178), (22, 182))),
    ],
)
def test_what_is_drawn_into_images_is_found_with_its_rectangle(
    draw: Callable[[Image, int], None], inside: tuple[tuple[int, int], tuple[int, int]]
) -> None:
    data = drawn(draw)
    found = find_burnt_in(data, data.rig)
    assert found.keys() == {*PAIR}
    (left, top), (right, bottom) = inside
    for each in found.values():
        assert each.mask[top : bottom + 1, left : right + 1].mean() > 0.9
        assert each.mask.mean() < 0.1
        assert any(
            a <= left and b <= top and right < c and bottom < d for a, b, c, d in each.rectangles
        )


def test_the_scene_is_not_burnt_in_however_often_it_is_seen() -> None:
    drive = drawn(nothing)
    stands = replace(drive, frames=tuple(drive.frames[i] for i in (0, 0, 1, 1, 1, 0)))
    for data in (drive, stands, drawn(nothing, slice(1))):
        assert hide_burnt_in(data, data.rig) is data


def test_in_few_frames_what_cameras_that_look_elsewhere_have_in_common_is_burnt_in() -> None:
    two, one = drawn(logo, slice(2)), drawn(logo, slice(1))
    assert find_burnt_in(two, two.rig).keys() == {*PAIR}
    assert not find_burnt_in(one, one.rig)  # two views can be alike by chance
    R = two.rig.T_camera_lidar
    beside = two.rig.moved_to({"left": R["front_left"]})
    assert not find_burnt_in(two, beside)  # where what is far is at the same pixels


def test_its_features_match_no_more() -> None:
    data = drawn(text)
    hidden = hide_burnt_in(data, data.rig)
    assert len(describe_burnt_in(hidden)) == len(PAIR)
    counts = []
    for each in (data, hidden):
        one, two = (features_of(each.frames[0], n, data.rig.cameras[n]) for n in PAIR)
        rows = match_features(one, two)
        apart = np.linalg.norm(one.pixels_px[rows[:, 0]] - two.pixels_px[rows[:, 1]], axis=1)
        counts.append(int(np.sum(apart < 1.0)))
    assert counts[0] > 20 and counts[1] == 0
