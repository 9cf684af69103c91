"""Recordings that differ from the usual: what is read of them, or the one line about them."""

from __future__ import annotations

import gzip
import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from calibgraph import BagOptions, CalibrationError, DatasetError, FileError, load_dataset, load_rig
from calibgraph.io.bags.rig import read_bag_rig, rig_of_bag
from calibgraph.io.ros_messages import image_from_message
from tests.conftest import SAMPLE
from tests.io.bags.writing import (
    KINDS,
    START_NS,
    STORES,
    Messages,
    Stamped,
    sample_messages,
    write_bag,
)

MAKE = Messages("mcap")
RIG = load_rig(SAMPLE)
NAMES = [*RIG.cameras]
Change = Callable[[Stamped], Stamped | None]


def recording(folder: Path, change: Change, kind: str = "mcap") -> Path:
    """The sample's bag with some messages changed or left out."""
    changed = [change(each) for each in sample_messages(Messages(kind))]
    kept = [each for each in changed if each is not None]
    return write_bag(folder, kind, sorted(kept, key=lambda each: each.record_ns))


def renamed(image: str, info: str) -> Change:
    """Topics by the cameras' names."""

    def change(each: Stamped) -> Stamped:
        name = each.topic.split("/")[1]
        if name not in NAMES:
            return each
        topic = info if each.topic.endswith("camera_info") else image
        return replace(each, topic=topic.format(name))

    return change


@pytest.mark.parametrize(
    ("image", "info"),
    [
        ("/{}_image", "/{}_camera_info"),
        ("/cams/image_{}", "/cams/camera_info_{}"),
        ("/cams/{}/compressed", "/cams/{}/camera_info"),
        ("/cams/{}/compressed", "/cams/{}_info"),
        ("/rig/{}_camera_image_raw/compressed", "/rig/{}_camera_info"),
        ("/rig/{}_camera/image_raw/compressed", "/rig/{}_camera/image_raw/camera_info"),
        ("/rig/{}_rgb", "/rig/{}_camera_info"),
    ],
)
def test_cameras_of_one_namespace_have_their_own_lens(
    tmp_path: Path, image: str, info: str
) -> None:
    bag = recording(tmp_path, renamed(image, info))
    by_frame = {camera.frame_id: camera for camera in rig_of_bag(bag).cameras.values()}
    assert len(by_frame) == len(NAMES)
    topics = {name: image.format(name) for name in NAMES}
    for name, camera in rig_of_bag(bag, BagOptions(topics=topics)).cameras.items():
        assert camera.frame_id == f"{name}_optical"
        np.testing.assert_allclose(camera.T_camera_lidar, RIG.T_camera_lidar[name], atol=1e-9)


TEXTS = {
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": ("republish ffmpeg raw", "image"),
    "foxglove_msgs/msg/CompressedVideo": ("republish foxglove raw", "image"),
    "theora_image_transport/msg/Packet": ("republish theora raw", "image"),
    "point_cloud_interfaces/msg/CompressedPointCloud2": ("point_cloud_transport republ", "points"),
    "velodyne_msgs/msg/VelodyneScan": ("packets, which are not read", "points"),
}


@pytest.mark.parametrize("kind", TEXTS)
def test_video_and_packets_are_named_with_the_way_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("uint8[] data", kind))
    monkeypatch.setitem(STORES, False, store)
    expected, replaced = TEXTS[kind]

    def change(each: Stamped) -> Stamped:
        if replaced not in each.topic:
            return each
        content = store.types[kind](data=np.zeros(9, np.uint8))
        return Stamped(each.topic, kind, each.record_ns, content)

    with pytest.raises(DatasetError, match=expected):
        load_rig(recording(tmp_path, change))


@pytest.mark.parametrize("frames", [("eye", "eye", "eye"), ("/eye", "eye", "left_optical")])
def test_cameras_that_name_one_frame_are_named_and_not_tied(
    tmp_path: Path, frames: tuple[str, ...]
) -> None:
    def change(each: Stamped) -> Stamped:
        if each.topic.endswith("camera_info"):
            each.content.header.frame_id = frames[NAMES.index(each.topic.split("/")[1])]
        if each.topic == "/tf_static":
            T = np.linalg.inv(RIG.T_camera_lidar["front_left"])
            edges = [("velodyne", "eye", T), ("velodyne", "left_optical", np.eye(4))]
            return replace(each, content=MAKE.transforms(edges))
        return each

    bag = recording(tmp_path, change)
    (note,) = [note for note in read_bag_rig(bag).notes if "name one frame, 'eye'" in note]
    assert note in load_dataset(bag).notes
    with pytest.raises(DatasetError, match="so their relative pose is not known"):
        rig_of_bag(bag, relative_sigmas=(0.001, 0.003))


def infos(number_of: Callable[[int], Any]) -> Change:
    """A CameraInfo beside each image of ``left``, whose fields a function of its number changes."""
    camera = RIG.cameras["left"]

    def change(each: Stamped) -> Stamped | None:
        if each.topic == "/left/camera_info":
            return None
        if each.topic.startswith("/front_left/image"):  # a message of this camera becomes one
            number = (each.record_ns - START_NS) // 100_000_000
            content = MAKE.camera_info(camera, "left_optical", **number_of(number))
            kind = "sensor_msgs/msg/CameraInfo"
            return Stamped("/left/camera_info", kind, each.record_ns, content)
        return None if each.topic.startswith("/front") else each

    return change


def zoomed(by: float) -> dict[str, Any]:
    K = RIG.cameras["left"].matrix_px * [[by], [by], [1.0]]
    return {"K": K.ravel()}


@pytest.mark.parametrize(
    ("fields", "frames", "note"),
    [
        (lambda n: {"K": np.zeros(9)} if n == 0 else {}, 6, "1 camera_info have no lens"),
        (lambda n: {"K": np.zeros(9)} if n in (0, 1, 4) else {}, 6, "3 camera_info have no lens"),
        (lambda n: zoomed(1.25) if n >= 3 else {}, 3, "3 frames with another lens than the rig's"),
        (lambda n: zoomed(1.25) if n == 3 else {}, 5, "1 frames with another lens than the rig's"),
        (lambda n: {"width": 320, "height": 180} if n >= 4 else {}, 4, "to 320x180 px"),
        (lambda n: {"distortion_model": "equidistant", "D": np.full(4, 0.1)} if n >= 5 else {}, 5,
         "1 frames with another lens"),
        (lambda n: zoomed(1 + 1e-4 * (n % 3)), 6, ""),
    ],
)  # fmt: skip
def test_a_camera_info_that_changes_is_noted_and_its_frames_left_out(
    tmp_path: Path, fields: Callable[[int], Any], frames: int, note: str
) -> None:
    bag = recording(tmp_path, infos(fields))
    data = load_dataset(bag)
    assert data.rig.cameras["left"].intrinsics_px == RIG.cameras["left"].intrinsics_px
    assert len(data.frames) == frames
    found = data.notes[-1].rpartition("clouds, ")[2]
    assert note in found and ("camera_info" in found) == bool(note)


def test_without_any_lens_the_first_camera_info_is_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"/left/camera_info: K: .*not calibrated"):
        load_dataset(recording(tmp_path, infos(lambda _: {"K": np.zeros(9)})))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("topic", "record_ns"),
    [
        ("/tf_static", 0),
        ("/left/camera_info", 0),
        ("/tf_static", START_NS + 10**17),
        ("/left/image_raw/compressed", 0),
        ("/points", START_NS + 10**17),
    ],
)
def test_a_time_of_recording_that_is_wrong_costs_nothing(
    tmp_path: Path, kind: str, topic: str, record_ns: int
) -> None:
    done = set()

    def change(each: Stamped) -> Stamped:
        if each.topic != topic or topic in done:
            return each
        done.add(topic)
        return replace(each, record_ns=record_ns)

    bag = recording(tmp_path, change, kind)
    data = load_dataset(bag, bag=BagOptions(every_s=0.1))
    whole = load_dataset(bag)
    lost = topic in ("/left/image_raw/compressed", "/points")
    assert len(data.frames) == len(whole.frames) == (5 if lost else 6)
    assert max(frame.index for frame in data.frames) < 20


def test_clouds_of_another_frame_are_left_out_and_counted(tmp_path: Path) -> None:
    def change(each: Stamped) -> Stamped:
        if each.topic == "/points" and (each.record_ns - START_NS) // 100_000_000 in (2, 5):
            each.content.header.frame_id = "rear"
        return each

    data = load_dataset(recording(tmp_path, change))
    assert len(data.frames) == 4
    assert "/points: 2 name another frame than the first (rear, not velodyne)" in data.notes[-1]


def turned(orientation: int, form: str) -> bytes:
    mark, data = Image.Exif(), io.BytesIO()
    mark[0x0112] = orientation
    path = next((SAMPLE / "cameras" / "left").glob("*.jpg"))
    Image.open(path).save(data, form, exif=mark)
    return data.getvalue()


@pytest.mark.parametrize("orientation", [3, 6, 8])
@pytest.mark.parametrize("form", ["JPEG", "PNG"])
def test_an_orientation_in_a_message_is_refused(orientation: int, form: str) -> None:
    message = MAKE.compressed(turned(orientation, form), form.lower(), 0)
    with pytest.raises(DatasetError, match=f"has the EXIF orientation {orientation}, by which"):
        image_from_message(message)
    assert image_from_message(MAKE.compressed(turned(1, form), form.lower(), 0)).shape[2] == 3


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("run.bag.active", r"not closed by the recorder: .*rosbag reindex.*rename it to run.bag"),
        ("run.bag.gz", "is compressed: unpack it first with `gunzip run.bag.gz`"),
        ("run_0.db3.zstd", "unpack it first with `unzstd run_0.db3.zstd`"),
        ("RUN.MCAP.ZST", "unpack it first with `unzstd RUN.MCAP.ZST`"),
        ("run.bag.bz2", "`bunzip2 run.bag.bz2`"),
        ("run.mcap.zip", "`unzip run.mcap.zip`"),
    ],
)
def test_a_bag_that_must_be_unpacked_or_closed_is_named(
    tmp_path: Path, name: str, expected: str
) -> None:
    path = tmp_path / name
    path.write_bytes(gzip.compress(b"no matter"))
    for read in (load_dataset, load_rig, lambda path: load_dataset(path, RIG)):
        with pytest.raises(FileError, match=expected):
            read(path)
