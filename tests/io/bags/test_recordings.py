"""Recordings as they are: clouds and images pair by stamps; what is odd is read, or named."""

import gzip
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard

from calibgraph import (
    BagOptions,
    CalibrationError,
    Dataset,
    DatasetError,
    FileError,
    load_dataset,
    load_rig,
)
from calibgraph.io.bags.rig import read_bag_rig
from calibgraph.io.frame import hash_source
from tests.conftest import SAMPLE
from tests.io.bags.writing import (
    KINDS,
    PERIOD_NS,
    START_NS,
    STORES,
    Messages,
    Stamped,
    require_same_frames,
    sample_bag,
    sample_messages,
    structured,
    write_bag,
)

POINTS, LEFT = "/points", "/left/image_raw/compressed"
MS = 1_000_000
MAKE = Messages("mcap")
RIG = load_rig(SAMPLE)
NAMES = [*RIG.cameras]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("raw", [False, True])
def test_frames_of_a_bag_equal_those_of_the_folder(tmp_path: Path, kind: str, raw: bool) -> None:
    bag = sample_bag(tmp_path, kind, raw=raw)
    folder, data = load_dataset(SAMPLE), load_dataset(bag)
    assert list(data.rig.cameras) == list(folder.rig.cameras)
    for name, camera in load_rig(bag).cameras.items():
        given = folder.rig.cameras[name]
        assert camera.frame_id == f"{name}_optical"
        others = {"T_camera_lidar", "frame_id", "mount"}
        assert camera.model_dump(exclude=others) == given.model_dump(exclude=others)
        np.testing.assert_allclose(camera.T_camera_lidar, given.T_camera_lidar, atol=1e-12)
    assert numbers(data) == numbers(folder)
    require_same_frames(data.select("::5"), folder.select("::5"))
    paths = [frame.cloud_path for frame in data.frames]
    assert len({hash_source(path) for path in paths}) == len(paths)


Change = Callable[[Stamped], Stamped | None]


def recording(folder: Path, change: Change, kind: str = "mcap") -> Path:
    """The sample's bag with some messages changed or left out."""
    changed = [change(each) for each in sample_messages(Messages(kind))]
    kept = [each for each in changed if each is not None]
    return write_bag(folder, kind, sorted(kept, key=lambda each: each.record_ns))


def number_of(each: Stamped) -> int:
    """The number of its frame."""
    return (each.record_ns - START_NS) // PERIOD_NS


def restamped(message: Stamped, stamp_ns: int) -> Stamped:
    header = message.content.header
    header.stamp.sec, header.stamp.nanosec = divmod(stamp_ns, 10**9)
    return message


def stamp_of(message: Stamped) -> int:
    return message.content.header.stamp.sec * 10**9 + message.content.header.stamp.nanosec


def numbers(data: Dataset) -> list[int]:
    return [frame.index for frame in data.frames]


def delayed(each: Stamped) -> Stamped:
    late = number_of(each) * 4 * MS if each.topic == LEFT else 0
    return restamped(each, stamp_of(each) + late) if late else each


def spoilt(each: Stamped) -> Stamped:
    """An empty cloud, and one that repeats a stamp."""
    if each.topic == POINTS and number_of(each) == 1:
        nothing = structured(np.full((5, 4), np.nan, np.float32))
        return replace(each, content=MAKE.cloud(nothing, stamp_of(each)))
    repeats = each.topic == POINTS and number_of(each) == 4
    return restamped(each, START_NS + 3 * PERIOD_NS) if repeats else each


def of_another_frame(each: Stamped) -> Stamped:
    if each.topic == POINTS and number_of(each) in (2, 5):
        each.content.header.frame_id = "rear"
    return each


LEFT_OUT: list[tuple[Change, BagOptions, list[int], str]] = [
    (delayed, BagOptions(), [0, 1, 2, 3, 4, 5], "6 clouds, 6 with all images within 0.05 s"),
    (delayed, BagOptions(sync_tolerance_s=0.012), [0, 1, 2],  # 3 ms, and 0, 4, 8, ...
     "left +7 ms (median), at most 11; 3 without an image of left"),
    (spoilt, BagOptions(), [0, 2, 3, 5], "/points: 1 have no point; /points: 1 repeat a stamp"),
    (of_another_frame, BagOptions(), [0, 1, 3, 4],
     "/points: 2 name another frame than the first (rear, not velodyne)"),
]  # fmt: skip


@pytest.mark.parametrize("row", LEFT_OUT, ids=lambda row: row[-1])
def test_messages_that_make_no_frame_are_left_out_and_counted(
    row: tuple[Change, BagOptions, list[int], str], tmp_path: Path
) -> None:
    change, options, kept, note = row
    data = load_dataset(recording(tmp_path, change), bag=options)
    assert [frame.name for frame in data.frames] == [str(START_NS + n * PERIOD_NS) for n in kept]
    assert note in data.notes[-1]


@pytest.mark.parametrize("kind", KINDS)
def test_after_a_clock_is_set_back_only_messages_of_one_time_pair(
    tmp_path: Path, kind: str
) -> None:
    def jump(each: Stamped) -> Stamped:
        if not hasattr(each.content, "header") or "info" in each.topic:
            return each
        late = replace(each, record_ns=each.record_ns + 10**10 * (number_of(each) >= 3))
        back = 3 * PERIOD_NS - 7 * MS if number_of(each) >= 3 else 0  # all sensors' clocks
        return restamped(late, stamp_of(each) - back)

    data = load_dataset(recording(tmp_path, jump, kind))
    assert "/points: 1 have a stamp before the last" in data.notes[-1]
    require_same_frames(data, load_dataset(SAMPLE))


def test_clocks_that_differ_are_named_and_the_time_of_recording_serves(tmp_path: Path) -> None:
    def since_start(each: Stamped) -> Stamped:
        return restamped(each, stamp_of(each) - START_NS) if each.topic == LEFT else each

    bag = recording(tmp_path, since_start)
    with pytest.raises(DatasetError, match=r"/left.* 0.003 to 0.503 s do not meet; set stamps"):
        load_dataset(bag)
    assert numbers(load_dataset(bag, bag=BagOptions(stamps="record"))) == [0, 1, 2, 3, 4, 5]


def long_bag(folder: Path, kind: str, frames: int) -> Path:
    """A bag of the sample's frames, again and again, 0.1 s apart."""
    data = load_dataset(SAMPLE)
    many = [replace(data.frames[k % 6], index=k) for k in range(frames)]
    return write_bag(
        folder, kind, sample_messages(Messages(kind), replace(data, frames=tuple(many)))
    )


@pytest.mark.parametrize("kind", KINDS)
def test_a_frame_in_each_period_is_picked_and_keeps_its_neighbours(
    tmp_path: Path, kind: str
) -> None:
    bag = long_bag(tmp_path, kind, 40)
    data = load_dataset(bag, bag=BagOptions(every_s=1.0))
    seconds = [(int(frame.name) - START_NS) / 1e9 for frame in data.frames]
    assert seconds == pytest.approx([0.2, 1.2, 2.2, 3.2])
    assert len(data.recorded) < 20  # of 40: the others are not read
    for frame in data.frames:
        after, before = data.neighbour(frame, 1), data.neighbour(frame, -1)
        assert after is not None and before is not None
        assert int(after.name) - int(before.name) == 2 * PERIOD_NS
    last = data.neighbour(data.frames[0], 1)
    while last is not None:  # no frame of the next second follows in the first
        assert int(last.name) - START_NS < 10**9
        last = data.neighbour(last, 1)
    few = load_dataset(bag, frames="1:3", bag=BagOptions(every_s=1.0))
    assert [frame.name for frame in few.frames] == [frame.name for frame in data.frames[1:3]]


def test_bags_and_folders_form_one_problem(tmp_path: Path) -> None:
    data = load_dataset([SAMPLE, sample_bag(tmp_path, "ros1")], load_rig(SAMPLE))
    assert numbers(data) == list(range(12))
    assert data.frames[6].name == f"drive.bag/{START_NS}"
    assert data.neighbour(data.frames[5], 1) is None


@pytest.mark.parametrize(
    ("kind", "compression"),
    [("ros1", "BZ2"), ("ros1", "LZ4"), ("sqlite3", "MESSAGE"), ("mcap", "STORAGE")],
)
def test_compressed_bags_hold_the_same(tmp_path: Path, kind: str, compression: str) -> None:
    one = load_dataset(SAMPLE, frames="0")
    messages = sample_messages(Messages(kind), one)
    data = load_dataset(write_bag(tmp_path, kind, messages, compression=compression))
    require_same_frames(data, one)


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_a_folder_of_files_compressed_as_a_whole_names_what_unpacks_them(
    tmp_path: Path, kind: str
) -> None:
    bag = write_bag(tmp_path, kind, sample_messages(Messages(kind)), compression="FILE")
    with pytest.raises(FileError, match=r"unpack them first with `unzstd drive_\w+\.\w+\.zstd`"):
        load_dataset(bag)
    (packed,) = bag.glob("*.zstd")
    with zstandard.open(packed, "rb") as content:
        packed.with_suffix("").write_bytes(content.read())
    assert len(load_dataset(packed.with_suffix("")).frames) == 6


def renamed(image: str, info: str) -> Change:
    """Topics by the cameras' names."""

    def change(each: Stamped) -> Stamped:
        name = each.topic.split("/")[1]
        if name not in NAMES:
            return each
        topic = info if each.topic.endswith("camera_info") else image
        return replace(each, topic=topic.format(name, NAMES.index(name)))

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
        ("/image_{1}/image_raw/compressed", "/image_{1}/camera_info"),
        ("/image{1}/image_raw/compressed", "/image{1}/image_raw/camera_info"),
    ],
)
def test_cameras_of_one_namespace_have_their_own_lens(
    tmp_path: Path, image: str, info: str
) -> None:
    bag = recording(tmp_path, renamed(image, info))
    by_frame = {camera.frame_id: camera for camera in load_rig(bag).cameras.values()}
    assert len(by_frame) == len(NAMES)
    topics = {name: image.format(name, n) for n, name in enumerate(NAMES)}
    for name, camera in load_rig(bag, BagOptions(topics=topics)).cameras.items():
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


def infos(fields_of: Callable[[int], Any]) -> Change:
    """A CameraInfo beside each image of ``left``, whose fields a function of its number changes."""
    camera = RIG.cameras["left"]

    def change(each: Stamped) -> Stamped | None:
        if each.topic == "/left/camera_info":
            return None
        if each.topic.startswith("/front_left/image"):  # a message of this camera becomes one
            content = MAKE.camera_info(camera, "left_optical", **fields_of(number_of(each)))
            kind = "sensor_msgs/msg/CameraInfo"
            return Stamped("/left/camera_info", kind, each.record_ns, content)
        return None if each.topic.startswith("/front") else each

    return change


def zoomed(by: float) -> dict[str, Any]:
    K = RIG.cameras["left"].matrix_px * [[by], [by], [1.0]]
    return {"K": K.ravel()}


@pytest.mark.parametrize(
    ("fields", "others"),
    [
        (lambda n: {"K": np.zeros(9)} if n in (0, 1, 4) else {}, 0),
        (lambda n: zoomed(1.25) if n >= 3 else {}, 3),
        (lambda n: {"width": 320, "height": 180} if n >= 4 else {}, 2),
        (lambda n: {"distortion_model": "equidistant", "D": np.full(4, 0.1)} if n >= 5 else {}, 1),
        (lambda n: zoomed(1 + 1e-4 * (n % 3)), 0),
    ],
)
def test_a_camera_info_that_changes_is_noted(
    tmp_path: Path, fields: Callable[[int], Any], others: int
) -> None:
    bag = recording(tmp_path, infos(fields))
    data = load_dataset(bag)
    assert data.rig.cameras["left"].intrinsics_px == RIG.cameras["left"].intrinsics_px
    assert len(data.frames) == 6
    found = data.notes[-1].rpartition("clouds, ")[2]
    note = f"left: {others} camera_info have another lens than the first"
    assert (note in found) == ("camera_info" in found) == bool(others)


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


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("run.bag.active", r"not closed: mend it with `rosbag reindex .*` and name it \S+run.bag"),
        ("run.bag.gz", r"is compressed: unpack it first with `gunzip \S+run.bag.gz`"),
        ("run_0.db3.zstd", r"`unzstd \S+run_0.db3.zstd`"),
        ("RUN.MCAP.ZST", r"`unzstd \S+RUN.MCAP.ZST`"),
        ("run.bag.bz2", r"`bunzip2 \S+run.bag.bz2`"),
        ("run.mcap.zip", "is an archive: unpack it"),
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
