"""Frames: images from disk, arrays in memory, what is kept of them, points moved to one instant."""

import io
import struct
import zlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import gtsam
import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import Base

import calibgraph
from calibgraph import CalibrationError, Dataset, FileError, Rig, dataset_from_arrays, load_rig
from calibgraph.io import dataset as kept_frames
from calibgraph.io.bags.pictures import image_from_message
from calibgraph.io.dataset import keep_frames
from calibgraph.io.frame import ScanMotion, twist_between
from calibgraph.io.images import load_image
from calibgraph.matching.camera_pairs.find import FEATURE, features_of
from calibgraph.pipeline import hash_inputs
from tests.conftest import SAMPLE, make_camera


def png(width_px: int, height_px: int, pixels: bytes) -> bytes:
    """A PNG with this header, whatever its pixels are."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        checked = kind + data
        return struct.pack(">I", len(data)) + checked + struct.pack(">I", zlib.crc32(checked))

    header = struct.pack(">IIBBBBB", width_px, height_px, 8, 2, 0, 0, 0)
    parts = chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(pixels)), chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


LEFT = load_rig(SAMPLE).cameras["left"]
JPG = (SAMPLE / "cameras" / "left" / "000000.jpg").read_bytes()
BGR = np.asarray(cv2.imdecode(np.frombuffer(JPG, np.uint8), cv2.IMREAD_COLOR))
MIDDLE = len(JPG) // 2


def coded(image: np.ndarray, suffix: str = ".png", *options: int) -> bytes:
    return cv2.imencode(suffix, image, options)[1].tobytes()


PNG = coded(BGR)
DARK, FLAT = np.full((LEFT.height_px, LEFT.width_px), 200, np.uint16), np.zeros((6000,) * 2, "u1")
NOT_LEFT = [
    *((name, part, name) for name, data in (("image.jpg", JPG), ("image.png", PNG))
      for part in (data[: len(data) // 2], data[:-5], b"", b"no image at all")),
    # the first and last bytes of these are right
    ("half.jpg", JPG[:MIDDLE] + b"\xff\xd9", "half.jpg: is damaged"),
    ("gap.jpg", JPG[:MIDDLE] + JPG[MIDDLE + 500 :], "gap.jpg: is damaged"),
    ("flipped.png", PNG[: len(PNG) // 2] + bytes(1) + PNG[len(PNG) // 2 + 1 :], "is damaged"),
    ("short.png", png(LEFT.width_px, LEFT.height_px, bytes(1000)), "short.png: is damaged"),
    ("narrow.png", coded(BGR[:, :-2]), "is 638x360 px, the rig says 640x360 px"),
    *(("bomb.png", png(side, side, bytes(1000)), f"is {side}x{side} px, the rig says 640x360 px")
      for side in (28_000, 10**6, 2**31 - 1)),  # compared before memory is taken
    ("dark.png", coded(DARK), "16 bits and uses only the lower 8"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "data", "said"), NOT_LEFT, ids=range(len(NOT_LEFT)))
def test_what_is_no_image_of_the_camera_is_named_and_not_filled_up(
    name: str, data: bytes, said: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(FileError, match=said):
        load_image(tmp_path / name, LEFT)
    (tmp_path / "whole.png").write_bytes(PNG)
    np.testing.assert_array_equal(load_image(tmp_path / "whole.png", LEFT), BGR)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_an_image_that_states_more_pixels_than_its_bytes_hold_is_refused(
    suffix: str, tmp_path: Path
) -> None:
    path, size = tmp_path / f"image{suffix}", {"width_px": 6000, "height_px": 6000}
    path.write_bytes(coded(FLAT, suffix, cv2.IMWRITE_JPEG_QUALITY, 5))
    with pytest.raises(FileError, match=r"it states 6000x6000 px in \d+ kB: no picture packs so"):
        load_image(path, LEFT.model_copy(update=size))


@pytest.mark.parametrize("suffix", ["jpg", "png"])
@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_an_image_that_programs_turn_differently_is_refused(
    orientation: int, suffix: str, tmp_path: Path
) -> None:
    exif, path = Image.Exif(), tmp_path / f"turned.{suffix}"
    exif[Base.Orientation] = orientation
    Image.open(io.BytesIO(JPG)).save(path, exif=exif)
    form = {"jpg": "jpeg", "png": "png"}[suffix]
    message = SimpleNamespace(data=np.fromfile(path, np.uint8), format=form)
    for read in (lambda: load_image(path, LEFT), lambda: image_from_message(message, "a bag")):
        if orientation == 1:
            assert read().any()
        else:
            with pytest.raises(CalibrationError, match=f"has the EXIF orientation {orientation}"):
                read()


def test_profiles_in_a_png_print_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Libpng's warnings would be lines on a user's terminal; the pixels do not depend on them."""
    camera = make_camera()
    pixels = np.random.default_rng(0).integers(0, 256, (camera.height_px, camera.width_px, 3))
    image = Image.fromarray(pixels.astype(np.uint8))
    image.save(tmp_path / "bad.png", icc_profile=b"no profile" * 20)
    np.testing.assert_array_equal(load_image(tmp_path / "bad.png", camera), pixels[:, :, ::-1])
    assert capfd.readouterr().err == ""


SMALL = make_camera().model_copy(update={"width_px": 8, "height_px": 6})
RIG = Rig(cameras={"front": SMALL})
CLOUD = np.array([[1.0, 2.0, 3.0, 0.5], [4.0, 5.0, 6.0, 0.25]], np.float32)
IMAGE = np.arange(8 * 6 * 3, dtype=np.uint8).reshape(6, 8, 3)


def dataset(cloud: Any = CLOUD, image: Any = IMAGE, rig: Rig = RIG) -> Dataset:
    return dataset_from_arrays(rig, [cloud, cloud], {"front": [image, image]})


def test_frames_hold_what_was_given() -> None:
    data = dataset()
    assert [frame.index for frame in data.frames] == [0, 1]
    np.testing.assert_array_equal(data.frames[1].load_cloud(), CLOUD)
    np.testing.assert_array_equal(data.frames[1].load_image("front", SMALL), IMAGE)
    assert data.neighbour(data.frames[0], 1) is data.frames[1]
    assert data.notes == ()
    assert dataset(cloud=CLOUD[:, :3]).notes[0].startswith("clouds[0]: no intensity among its fie")


NAMED = np.zeros(2, [("Reflectivity", "u1"), ("z", "f8"), ("y", "f8"), ("x", "f8"), ("t", "O")])
for column, axis in enumerate("xyz"):
    NAMED[axis] = CLOUD[:, column]
NAMED["Reflectivity"] = 3, 4
NO_INTENSITY = np.column_stack([CLOUD[:, :3], [np.nan, np.nan]])


@pytest.mark.parametrize(
    ("cloud", "expected"),
    [
        (CLOUD[:, :3].astype(np.float64), NO_INTENSITY),
        (CLOUD.tolist(), CLOUD),
        (NAMED, np.column_stack([CLOUD[:, :3], [3, 4]])),
        (np.vstack([np.zeros((1, 4)), CLOUD, np.full((1, 4), np.nan)]), CLOUD),
    ],
    ids=["three doubles", "lists", "named fields", "no returns"],
)
def test_clouds_of_any_array_are_taken(cloud: Any, expected: Any) -> None:
    found = dataset(cloud=cloud).frames[0].load_cloud()
    np.testing.assert_array_equal(found, expected)
    assert found.dtype == np.float32


@pytest.mark.parametrize("channels", [1, 4])
def test_gray_images_and_those_with_alpha_become_bgr(channels: int) -> None:
    gray = IMAGE[:, :, 0]
    given = gray if channels == 1 else np.dstack([IMAGE, gray])
    found = dataset(image=given).frames[0].load_image("front", SMALL)
    expected = np.dstack([gray] * 3) if channels == 1 else IMAGE
    np.testing.assert_array_equal(found, expected)


def test_equal_arrays_have_equal_hashes_under_names_of_their_own() -> None:
    one, two = (hash_inputs(dataset()) for _ in range(2))
    assert sorted(one.values()) == sorted(two.values())
    assert not one.keys() & two.keys()  # caches tell datasets apart by the paths


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"cloud": CLOUD[:, :2]}, r"clouds\[0\]: has shape \(2, 2\), expected \(n, 3\)"),
        ({"cloud": CLOUD[:0]}, r"clouds\[0\]: holds no point"),
        ({"cloud": np.full((2, 3), np.inf)}, r"clouds\[0\]: point 0 is not finite"),
        ({"cloud": np.tile(CLOUD, (99, 1)).T}, r"clouds\[0\]: .*is it transposed\?"),
        ({"cloud": [[1.0, 2.0, 3.0], [4.0, 5.0]]}, r"clouds\[0\]: .*; give an array"),
        ({"cloud": None}, r"clouds\[0\]: has shape \(\) of object"),
        (
            {"image": IMAGE.astype(float)},
            r"images\['front'\]\[0\] has shape \(6, 8, 3\) of float64, expected",
        ),
        (
            {"image": IMAGE[:, :7]},
            r"images\['front'\]\[0\] has shape \(6, 7, 3\) of uint8, expected \(6, 8, 3\)",
        ),
        ({"image": IMAGE[None]}, r"images\['front'\]\[0\] has shape"),
        ({"rig": Rig(cameras={"rear": SMALL})}, "images are of front, the rig has rear"),
    ],
)
def test_what_does_not_fit_is_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        dataset(**given)


@pytest.mark.parametrize(
    ("clouds", "images", "message"),
    [
        (CLOUD, {"front": [IMAGE]}, r"clouds is one array of shape \(2, 4\), expected a list"),
        (iter([CLOUD]), {"front": [IMAGE]}, "clouds is of type list_iterator, expected a list"),
        ([CLOUD], {"front": IMAGE[:, :, 0]}, r"images\['front'\] is one array"),
        ([CLOUD], {"front": None}, r"images\['front'\] is of type NoneType"),
        ([CLOUD], [IMAGE], "images are of no camera by name, the rig has front"),
        ([CLOUD, CLOUD], {"front": [IMAGE]}, "2 clouds, but 1 images"),
        ([], {"front": []}, "no frame given"),
    ],
)
def test_arguments_that_are_no_lists_of_one_length_are_one_line(
    clouds: Any, images: Any, message: str
) -> None:
    with pytest.raises(CalibrationError, match=message) as caught:
        dataset_from_arrays(RIG, clouds, images)
    assert "\n" not in str(caught.value)


def test_features_of_kept_frames_are_found_once_per_lens() -> None:
    data = calibgraph.load_dataset(SAMPLE)
    frame, camera = keep_frames(data).frames[0], data.rig.cameras["left"]
    found = features_of(frame, "left", camera)
    assert features_of(frame, "left", camera) is found
    other = camera.model_copy(
        update={"intrinsics_px": camera.intrinsics_px.model_copy(update={"fx": 500.0})}
    )
    assert not np.allclose(features_of(frame, "left", other)["ray"], found["ray"])
    plain = features_of(data.frames[0], "left", camera)
    np.testing.assert_array_equal(plain, found)


def test_what_was_used_last_is_kept_up_to_a_size(monkeypatch: pytest.MonkeyPatch) -> None:
    value = np.zeros(100, FEATURE)
    monkeypatch.setattr(kept_frames, "MAX_BYTES", 2 * value.nbytes)
    frame, made = keep_frames(calibgraph.load_dataset(SAMPLE)).frames[0], list[str]()

    def derive(key: str) -> None:
        frame.derive(key, lambda: made.append(key) or value)

    for key in "aabacab":
        derive(key)
    assert "".join(made) == "abcb"


RNG = np.random.default_rng(4)
TURNING = (0.02, -0.05, 0.4, 12.0, 0.3, -0.1)


def pose_at(twist: tuple[float, ...], seconds: float) -> np.ndarray:
    return np.asarray(gtsam.Pose3.Expmap(np.array(twist) * seconds).matrix())


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e-9, 0.0])
def test_a_moving_scan_is_that_of_one_instant(scale: float) -> None:
    """Each point seen from where the LiDAR is at its time; turning fast, slowly and not at all."""
    twist = tuple(scale * w for w in TURNING[:3]) + TURNING[3:]
    world = RNG.uniform(-50, 50, (500, 3))
    times = RNG.uniform(-0.1, 0.1, 500)
    seen = np.array(
        [np.linalg.inv(pose_at(twist, t)) @ [*p, 1] for t, p in zip(times, world, strict=True)]
    )
    inverse = np.linalg.inv(pose_at(twist, 0.03))
    expected = world @ inverse[:3, :3].T + inverse[:3, 3]
    found = ScanMotion(twist, to_s=0.03).correct(seen[:, :3], times)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)  # 50 m of float64


def test_the_twist_is_that_of_the_poses() -> None:
    T = pose_at((0.3, 0.2, -0.1, 5, 4, 3), 1.7)
    found = twist_between(T, T @ pose_at(TURNING, 0.1), 0.1)
    np.testing.assert_allclose(found, TURNING, atol=1e-9)
