"""PointCloud2 messages of any layout hold the same points."""

from __future__ import annotations

import numpy as np
import pytest

from calibgraph import DatasetError
from calibgraph.io.bags.point_clouds import has_points, points_of
from tests.io.bags.writing import START_NS, Messages, structured

CLOUD = np.random.default_rng(3).normal(0.0, 20.0, (120, 4)).astype(np.float32)
MAKE = Messages("mcap")


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("names", "gap"), [("xyzi", 0), ("izyx", 0), ("yixz", 3), ("xyzi", 12)])
def test_fields_of_any_order_and_byte_order_are_read(order: str, names: str, gap: int) -> None:
    message = MAKE.cloud(structured(CLOUD, names, order=order, gap=gap), START_NS)
    assert message.is_bigendian == (order == ">")
    np.testing.assert_array_equal(points_of(message, "here"), CLOUD)


def test_organised_clouds_with_padded_rows_are_read() -> None:
    message = MAKE.cloud(structured(CLOUD), START_NS, height=6, padding=5)
    assert (message.height, message.width, message.row_step) == (6, 20, 20 * 16 + 5)
    np.testing.assert_array_equal(points_of(message, "here"), CLOUD)


def test_points_without_a_return_are_left_out() -> None:
    cloud = CLOUD.copy()
    cloud[3, :3] = np.nan
    cloud[5, 1] = np.nan
    cloud[8, 0] = np.inf
    cloud[20, :3] = 0.0
    found = points_of(MAKE.cloud(structured(cloud), START_NS, height=4), "here")
    np.testing.assert_array_equal(found, np.delete(CLOUD, [3, 5, 8, 20], axis=0))


def test_doubles_and_whole_numbers_are_read() -> None:
    kind = np.dtype(
        [("ring", "<u2"), ("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("reflectivity", "u1")]
    )
    points = np.zeros(len(CLOUD), kind)
    points["x"], points["y"], points["z"] = CLOUD[:, :3].T
    points["reflectivity"] = np.arange(len(CLOUD))
    found = points_of(MAKE.cloud(points, START_NS), "here")
    np.testing.assert_array_equal(found[:, :3], CLOUD[:, :3])
    np.testing.assert_array_equal(found[:, 3], np.arange(len(CLOUD)))


def test_intensity_is_known_by_the_names_that_files_have_for_it() -> None:
    kind = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("scalar_Intensity", "f4")]
    points = np.zeros(len(CLOUD), kind)
    for column, (name, _) in enumerate(kind):
        points[name] = CLOUD[:, column]
    np.testing.assert_array_equal(points_of(MAKE.cloud(points, START_NS), "here"), CLOUD)


def test_a_cloud_without_intensity_has_none() -> None:
    found = points_of(MAKE.cloud(structured(CLOUD, "xyz"), START_NS), "here")
    assert np.isnan(found[:, 3]).all()


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_a_scan_that_sees_nothing_has_no_points(value: float) -> None:
    assert not has_points(MAKE.cloud(structured(np.full_like(CLOUD, value)), START_NS), "here")
    assert not has_points(MAKE.cloud(structured(CLOUD[:0]), START_NS), "here")
    assert has_points(MAKE.cloud(structured(CLOUD), START_NS), "here")


def test_clouds_without_coordinates_or_cut_short_are_named() -> None:
    with pytest.raises(DatasetError, match=r"here: its fields x, y, intensity have no x y z"):
        points_of(MAKE.cloud(structured(CLOUD, "xyi"), START_NS), "here")
    message = MAKE.cloud(structured(CLOUD), START_NS)
    message.data = message.data[:-1]
    with pytest.raises(DatasetError, match=r"has 1919 bytes for 120 x 1 points of 16 bytes"):
        points_of(message, "here")
