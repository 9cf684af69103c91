"""Frames of bags are those of the folder; clouds and images are paired by their stamps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibgraph import BagOptions, Dataset, DatasetError, calibrate, load_dataset, load_rig
from calibgraph.io.frame import hash_source
from tests.conftest import SAMPLE
from tests.io.bags.writing import (
    KINDS,
    PERIOD_NS,
    START_NS,
    Messages,
    Stamped,
    sample_bag,
    sample_messages,
    structured,
    write_bag,
)

POINTS, LEFT = "/points", "/left/image_raw/compressed"
MS = 1_000_000


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
    assert [frame.index for frame in data.frames] == list(range(len(folder.frames)))
    for found, expected in zip(data.frames[::5], folder.frames[::5], strict=True):
        np.testing.assert_array_equal(found.load_cloud(), expected.load_cloud())
        for name, camera in folder.rig.cameras.items():
            np.testing.assert_array_equal(
                found.load_image(name, camera), expected.load_image(name, camera)
            )
    paths = [frame.cloud_path for frame in data.frames]
    assert len({hash_source(path) for path in paths}) == len(paths)


@pytest.mark.realdata
@pytest.mark.parametrize("kind", KINDS)
def test_recorded_frames_are_the_same_from_a_bag(tmp_path: Path, realdata: Path, kind: str) -> None:
    folder = load_dataset(realdata / "kitti_odometry" / "sequences" / "05", frames="0:3")
    for raw in (False, True):
        bag = sample_bag(tmp_path / str(raw), kind, data=folder, raw=raw)
        data = load_dataset(bag)
        for found, expected in zip(data.frames, folder.frames, strict=True):
            np.testing.assert_array_equal(found.load_cloud(), expected.load_cloud())
            for name, camera in data.rig.cameras.items():
                np.testing.assert_array_equal(
                    found.load_image(name, camera), expected.load_image(name, camera)
                )


@pytest.mark.slow
def test_a_calibration_from_a_bag_equals_that_from_the_folder(tmp_path: Path) -> None:
    rig = load_rig(SAMPLE)
    results = [calibrate(data, rig) for data in (sample_bag(tmp_path, "mcap"), SAMPLE)]
    for name in rig.cameras:
        one, two = (result.T_camera_lidar[name] for result in results)
        np.testing.assert_array_equal(one, two)
        np.testing.assert_array_equal(*(result.covariance[name] for result in results))
    assert results[0].verdict.status == results[1].verdict.status
    assert list(results[0].inputs) != list(results[1].inputs)


def changed(
    folder: Path, change: Callable[[int, Stamped], Stamped | None], kind: str = "mcap"
) -> Path:
    """The sample's bag with some messages changed or left out.

    Args:
        folder: where to write it.
        change: of the frame's number and the message.
        kind: of the bag.
    """
    make = Messages(kind)
    messages = [
        change((each.record_ns - START_NS) // PERIOD_NS, each) for each in sample_messages(make)
    ]
    return write_bag(folder, kind, [each for each in messages if each is not None])


def restamped(message: Stamped, stamp_ns: int) -> Stamped:
    header = message.content.header
    header.stamp.sec, header.stamp.nanosec = divmod(stamp_ns, 10**9)
    return message


def stamp_of(message: Stamped) -> int:
    return message.content.header.stamp.sec * 10**9 + message.content.header.stamp.nanosec


def numbers(data: Dataset) -> list[int]:
    return [frame.index for frame in data.frames]


def test_images_pair_with_the_cloud_of_the_nearest_stamp(tmp_path: Path) -> None:
    def delay(number: int, each: Stamped) -> Stamped:
        late = number * 4 * MS if each.topic == LEFT else 0
        return restamped(each, stamp_of(each) + late) if late else each

    bag = changed(tmp_path, delay)
    assert numbers(load_dataset(bag)) == [0, 1, 2, 3, 4, 5]
    near = load_dataset(bag, bag=BagOptions(sync_tolerance_s=0.012))  # 3 ms, and 0, 4, 8, ...
    assert numbers(near) == [0, 1, 2]
    assert "6 clouds, 3 with all images within 0.012 s" in near.notes[-1]
    assert "left +7 ms (median), at most 11; 3 without an image of left" in near.notes[-1]


def test_repeated_stamps_and_empty_clouds_are_left_out_and_counted(tmp_path: Path) -> None:
    make = Messages("mcap")
    nothing = structured(np.full((5, 4), np.nan, np.float32))

    def spoil(number: int, each: Stamped) -> Stamped:
        if each.topic == POINTS and number == 1:
            return replace(each, content=make.cloud(nothing, stamp_of(each)))
        if each.topic == POINTS and number == 4:
            return restamped(each, START_NS + 3 * PERIOD_NS)
        return each

    data = load_dataset(changed(tmp_path, spoil))
    assert [frame.name for frame in data.frames] == [
        str(START_NS + number * PERIOD_NS) for number in (0, 2, 3, 5)
    ]
    assert "/points: 1 have no point; /points: 1 repeat a stamp" in data.notes[-1]


@pytest.mark.parametrize("kind", KINDS)
def test_after_a_clock_is_set_back_only_messages_of_one_time_pair(
    tmp_path: Path, kind: str
) -> None:
    def jump(number: int, each: Stamped) -> Stamped:
        if not hasattr(each.content, "header") or "info" in each.topic:
            return each
        late = replace(each, record_ns=each.record_ns + 10**10 * (number >= 3))
        back = 3 * PERIOD_NS - 7 * MS if number >= 3 else 0  # all sensors' clocks
        return restamped(late, stamp_of(each) - back)

    data = load_dataset(changed(tmp_path, jump, kind))
    expected = load_dataset(SAMPLE)
    assert len(data.frames) == 6
    assert "/points: 1 have a stamp before the last" in data.notes[-1]
    camera = data.rig.cameras["left"]
    for found, frame in zip(data.frames, expected.frames, strict=True):
        np.testing.assert_array_equal(found.load_cloud(), frame.load_cloud())
        np.testing.assert_array_equal(
            found.load_image("left", camera), frame.load_image("left", camera)
        )


def test_clocks_that_differ_are_named_and_the_time_of_recording_serves(tmp_path: Path) -> None:
    def since_start(_: int, each: Stamped) -> Stamped:
        return restamped(each, stamp_of(each) - START_NS) if each.topic == LEFT else each

    bag = changed(tmp_path, since_start)
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


def test_times_of_points_are_noticed(tmp_path: Path) -> None:
    make = Messages("mcap")

    def with_times(_: int, each: Stamped) -> Stamped:
        if each.topic != POINTS:
            return each
        points = np.zeros(50, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4")])
        points["x"] = 5.0
        return replace(each, content=make.cloud(points, stamp_of(each)))

    data = load_dataset(changed(tmp_path, with_times))
    assert data.notes[-1].endswith(
        "points have a t: unless they are corrected for motion, give --motion odometry, tf or "
        "scans, or stand still"
    )


@pytest.mark.parametrize(
    ("kind", "compression"),
    [("ros1", "BZ2"), ("ros1", "LZ4"), ("sqlite3", "FILE"), ("sqlite3", "MESSAGE"),
     ("mcap", "STORAGE")],
)  # fmt: skip
def test_compressed_bags_hold_the_same(tmp_path: Path, kind: str, compression: str) -> None:
    messages = sample_messages(Messages(kind))
    data = load_dataset(write_bag(tmp_path, kind, messages, compression=compression))
    for found, expected in zip(data.frames[::5], load_dataset(SAMPLE).frames[::5], strict=True):
        np.testing.assert_array_equal(found.load_cloud(), expected.load_cloud())
        for name, camera in data.rig.cameras.items():
            np.testing.assert_array_equal(
                found.load_image(name, camera), expected.load_image(name, camera)
            )
