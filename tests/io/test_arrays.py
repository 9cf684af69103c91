"""Datasets of arrays are those of files; what does not fit together is refused in one line."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from calibgraph import CalibrationError, Dataset, Rig, dataset_from_arrays
from calibgraph.pipeline import hash_inputs
from tests.conftest import make_camera

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


def test_clouds_of_three_columns_and_of_doubles_are_taken() -> None:
    given = CLOUD[:, :3].astype(np.float64)
    found = dataset(cloud=given).frames[0].load_cloud()
    np.testing.assert_array_equal(found[:, :3], CLOUD[:, :3])
    assert found.dtype == np.float32
    assert np.isnan(found[:, 3]).all()


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
        ({"cloud": CLOUD[0]}, r"clouds\[0\]: has shape \(4,\)"),
        ({"cloud": CLOUD.astype(object)}, r"clouds\[0\]: has shape .* of object"),
        ({"cloud": CLOUD[:0]}, r"clouds\[0\]: holds no point"),
        ({"cloud": np.full((2, 3), np.inf)}, r"clouds\[0\]: point 0 is not finite"),
        ({"cloud": np.zeros((9, 4))}, r"clouds\[0\]: all of its 9 points lie at the origin"),
        ({"cloud": np.tile(CLOUD, (9, 1)).T}, r"clouds\[0\]: .*\(4, 18\).* is it transposed\?"),
        ({"cloud": np.tile(CLOUD, (99, 1)).T}, r"clouds\[0\]: .*is it transposed\?"),
        ({"cloud": [[1.0, 2.0, 3.0], [4.0, 5.0]]}, r"clouds\[0\]: .*; give an array"),
        ({"cloud": [["a", "b", "c"]]}, r"clouds\[0\]: has shape \(1, 3\) of <U1"),
        ({"cloud": None}, r"clouds\[0\]: has shape \(\) of object"),
        ({"cloud": CLOUD * 1e6}, r"clouds\[0\]: holds a coordinate of 6e\+06, expected metres"),
        ({"cloud": CLOUD.astype(complex)}, r"clouds\[0\]: has shape .* of complex128"),
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


def test_lists_are_taken_as_arrays() -> None:
    data = dataset(cloud=CLOUD.tolist())
    np.testing.assert_array_equal(data.frames[0].load_cloud(), CLOUD)


def test_fields_of_arrays_are_known_by_their_names() -> None:
    named = np.zeros(2, [("Reflectivity", "u1"), ("z", "f8"), ("y", "f8"), ("x", "f8"), ("t", "O")])
    for column, name in enumerate(("x", "y", "z")):
        named[name] = CLOUD[:, column]
    named["Reflectivity"] = 3, 4
    expected = np.column_stack([CLOUD[:, :3], [3, 4]])
    np.testing.assert_array_equal(dataset(cloud=named).frames[0].load_cloud(), expected)


@pytest.mark.parametrize("nothing", [0.0, np.nan])
def test_points_without_a_return_are_left_out(nothing: float) -> None:
    given = np.vstack([[[nothing, nothing, nothing, 9.0]], CLOUD, [[nothing] * 4]])
    np.testing.assert_array_equal(dataset(cloud=given).frames[0].load_cloud(), CLOUD)


def test_clouds_without_intensity_are_noted() -> None:
    (note,) = dataset(cloud=CLOUD[:, :3]).notes
    assert note.startswith("clouds[0]: no intensity among its fields x y z; the error bars become")
    assert dataset().notes == ()


def test_numbers_of_clouds_and_images_must_agree() -> None:
    with pytest.raises(CalibrationError, match="2 clouds, but 1 images"):
        dataset_from_arrays(RIG, [CLOUD, CLOUD], {"front": [IMAGE]})
    with pytest.raises(CalibrationError, match="no frame given"):
        dataset_from_arrays(RIG, [], {"front": []})


@pytest.mark.parametrize(
    ("clouds", "images", "message"),
    [
        (CLOUD, {"front": [IMAGE]}, r"clouds is one array of shape \(2, 4\), expected a list"),
        (iter([CLOUD]), {"front": [IMAGE]}, "clouds is of type list_iterator, expected a list"),
        ([CLOUD], {"front": IMAGE[:, :, 0]}, r"images\['front'\] is one array"),
        ([CLOUD], {"front": None}, r"images\['front'\] is of type NoneType"),
        ([CLOUD], [IMAGE], "images are of no camera by name, the rig has front"),
    ],
)
def test_arguments_that_are_no_lists_are_one_line(clouds: Any, images: Any, message: str) -> None:
    with pytest.raises(CalibrationError, match=message) as caught:
        dataset_from_arrays(RIG, clouds, images)
    assert "\n" not in str(caught.value)
