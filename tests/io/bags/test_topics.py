"""Topics are found by type, and asked for by name where there are several."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibgraph import DatasetError
from calibgraph.io.bags.messages import Bag
from calibgraph.io.bags.topics import choose_topics
from tests.conftest import make_camera
from tests.io.bags.writing import START_NS, Messages, Stamped, structured, write_bag

MAKE = Messages("mcap")
GRAY = np.full((4, 6), 7, np.uint8)
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"


def bag_of(folder: Path, *topics: str, clouds: tuple[str, ...] = ("/points",)) -> Bag:
    """A bag with a message on each topic: images by their names, and clouds."""
    messages = []
    for name in clouds:
        cloud = MAKE.cloud(structured(np.ones((3, 4), np.float32)), START_NS)
        messages.append(Stamped(name, "sensor_msgs/msg/PointCloud2", START_NS, cloud))
    for name in topics:
        if name.endswith("info"):
            info = MAKE.camera_info(make_camera(), "eye")
            messages.append(Stamped(name, "sensor_msgs/msg/CameraInfo", START_NS, info))
        elif name.endswith("compressed"):
            image = MAKE.compressed(b"", "jpeg", START_NS)
            messages.append(Stamped(name, COMPRESSED, START_NS, image))
        else:
            depth = "depth" in name
            image = MAKE.image(
                GRAY.astype(np.uint16) if depth else GRAY, "16UC1" if depth else "mono8", START_NS
            )
            messages.append(Stamped(name, IMAGE, START_NS, image))
    return Bag(write_bag(folder, "mcap", messages))


def found(bag: Bag, **named: str) -> dict[str, str]:
    return {name: each.image for name, each in choose_topics(bag, named).cameras.items()}


def test_cameras_are_named_by_as_many_words_as_make_them_differ(tmp_path: Path) -> None:
    bag = bag_of(
        tmp_path, "/sensing/front/colour/image_raw", "/sensing/front/colour/camera_info",
        "/sensing/rear/colour/image_raw", "/sensing/rear/colour/camera_info",
    )  # fmt: skip
    assert found(bag) == {
        "front_colour": "/sensing/front/colour/image_raw",
        "rear_colour": "/sensing/rear/colour/image_raw",
    }


def test_images_as_recorded_come_before_rectified_and_compressed_ones(tmp_path: Path) -> None:
    kinds = ("image_rect", "image_raw/compressed", "image_raw", "camera_info")
    bag = bag_of(tmp_path / "all", *(f"/cam/{kind}" for kind in kinds))
    assert found(bag) == {"cam": "/cam/image_raw"}
    bag = bag_of(tmp_path / "two", *(f"/cam/{kind}" for kind in kinds if kind != "image_raw"))
    assert found(bag) == {"cam": "/cam/image_raw/compressed"}
    assert not choose_topics(bag, {}).cameras["cam"].rectified
    bag = bag_of(tmp_path / "one", "/cam/image_rect", "/cam/camera_info")
    assert choose_topics(bag, {}).cameras["cam"].rectified


def test_depth_and_images_without_a_lens_are_no_cameras(tmp_path: Path) -> None:
    bag = bag_of(
        tmp_path, "/d435/depth/image_raw", "/d435/depth/camera_info", "/ouster/signal_image",
        "/d435/color/image_raw", "/d435/color/camera_info",
    )  # fmt: skip
    assert found(bag) == {"color": "/d435/color/image_raw"}
    # a rig with the lens finds them by the names that they would have
    wanted = choose_topics(bag, {}, ["color", "ouster"]).cameras
    assert {name: each.image for name, each in wanted.items()} == {
        "color": "/d435/color/image_raw", "ouster": "/ouster/signal_image",
    }  # fmt: skip


def test_what_cannot_be_chosen_is_offered(tmp_path: Path) -> None:
    bag = bag_of(tmp_path / "two", "/a/image_raw", "/a/camera_info", clouds=("/p", "/q"))
    with pytest.raises(DatasetError, match=r"2 topics of clouds: /p \(1\), /q \(1\); name"):
        choose_topics(bag, {})
    with pytest.raises(DatasetError, match=r"no messages of /r \(lidar\); it has /a/image_raw"):
        choose_topics(bag, {"lidar": "/r"})
    with pytest.raises(DatasetError, match=r"images of camera 'rear'\? it has .* --topic rear="):
        choose_topics(bag, {"lidar": "/p"}, ["a", "rear"])
    with pytest.raises(DatasetError, match="--topic b: the rig has no such camera, but a"):
        choose_topics(bag, {"lidar": "/p", "b": "/a/image_raw"}, ["a"])
    empty = bag_of(tmp_path / "none", "/a/image_raw", "/a/camera_info", clouds=())
    with pytest.raises(DatasetError, match="has no messages of PointCloud2"):
        choose_topics(empty, {})
