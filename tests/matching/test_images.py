"""What is burnt into images is filled, and copies of a camera's images are named."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import calibgraph
from calibgraph import Dataset, dataset_from_arrays
from calibgraph.matching.burnt_in import describe_burnt_in, find_burnt_in, hide_burnt_in
from calibgraph.matching.camera_pairs.find import features_of, match_features
from calibgraph.matching.same_images import find_same_images, require_different_images
from tests.conftest import SAMPLE, Call

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
        apart = np.linalg.norm((one[rows[:, 0]]["pixel_px"] - two[rows[:, 1]]["pixel_px"]), axis=1)
        counts.append(int(np.sum(apart < 1.0)))
    assert counts[0] > 20 and counts[1] == 0


SIZE = (640, 360)
NOISE = np.random.default_rng(0).normal(0, 10, (*SIZE[::-1], 3))
CHANGES: dict[str, Callable[[Image], Image]] = {
    "as it is": lambda image: image,
    "compressed": lambda image: cv2.imdecode(cv2.imencode(".jpg", image, [1, 20])[1], 1),
    "brighter": lambda image: np.asarray(255 * (image / 255) ** 0.6, np.uint8),
    "cropped": lambda image: cv2.resize(image[36:324, 64:576], SIZE),
    "scaled": lambda image: cv2.resize(cv2.resize(image, (320, 180)), SIZE),
    "turned": lambda image: image[::-1, ::-1],
    "noisy": lambda image: np.clip(image + NOISE, 0, 255).astype(np.uint8),
}


def copied(change: Callable[[Image], Image], delay: int = 0) -> Dataset:
    """Some frames, whose front_right has changed images of front_left, some frames later."""
    data = calibgraph.load_dataset(SAMPLE).select("0:4")
    images = {
        name: [frame.load_image(name, camera) for frame in data.frames]
        for name, camera in data.rig.cameras.items()
    }
    own = images["front_left"]
    shown = [change(own[max(0, number - delay)]) for number in range(len(own))]
    return dataset_from_arrays(
        data.rig, [frame.load_cloud() for frame in data.frames], images | {"front_right": shown}
    )


@pytest.mark.parametrize(("change", "delay"), [*((name, 0) for name in CHANGES), ("compressed", 1)])
def test_copies_are_named_also_changed_or_a_frame_apart(change: str, delay: int) -> None:
    data = copied(CHANGES[change], delay)
    (line,) = find_same_images(data, data.rig)
    assert {"front_left", "front_right"} <= {*line.replace(",", " ").split()}
    assert ("a frame apart" in line) == (delay != 0)


def test_cameras_that_see_the_same_or_nothing_are_not_accused() -> None:
    for data in (calibgraph.load_dataset(SAMPLE), copied(np.zeros_like)):
        assert not find_same_images(data, data.rig)
        require_different_images(data, data.rig)


def test_every_command_names_them(tmp_path: Path, call: Call) -> None:
    data = Path(shutil.copytree(SAMPLE, tmp_path / "data"))
    for path in (data / "cameras/front_left").iterdir():
        shutil.copy(path, data / "cameras/front_right")
    for path in [*data.glob("lidar/*"), *data.glob("cameras/*/*")]:
        path.unlink() if path.stem > "000001" else None
    for command in (
        f"doctor {data}",
        f"calibrate {data} --out {tmp_path}/out",
        f"match {data} --out {tmp_path}/t.parquet",
        f"check {data}/rig.yaml {data}",
    ):
        code, printed, errors = call(*command.split())
        assert code == (1 if command.startswith("doctor") else 2), command
        words = " ".join((printed + errors).split())
        assert "front_left and front_right have the same images: one device under two" in words
