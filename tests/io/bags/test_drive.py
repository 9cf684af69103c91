"""Transforms and lenses of a drive: bad ones do not spoil it, and any of its bags may have them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibgraph import BagOptions, DatasetError, load_dataset, load_rig
from calibgraph.io.bags.rig import read_bag_rig
from calibgraph.model.geometry import invert, relative_transform, transform
from tests.conftest import SAMPLE, require_poses
from tests.io.bags.test_moving import messages as messages_of_a_drive
from tests.io.bags.writing import (
    PERIOD_NS,
    START_NS,
    STORES,
    Messages,
    Stamped,
    sample_messages,
    tree_of,
    without,
    write_bag,
)

TREE, OLD_TREE = "tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"
RIG = load_rig(SAMPLE)
MAKE = Messages("mcap")


def require_guess(bag: Path | list[Path]) -> tuple[str, ...]:
    """Check that the cameras are where the sample's guess has them; the notes."""
    data = load_dataset(bag)
    require_poses(data.rig.T_camera_lidar, RIG.T_camera_lidar, atol=1e-12)
    return data.notes


def spoilt(edge: tuple[str, str, Any], kind: str) -> Any:
    """A TFMessage of one transform that is none."""
    message = MAKE.transforms([edge])
    transform = message.transforms[0].transform
    if kind == "shift":
        transform.translation.x = float("inf")
    else:
        number = {"zero": 0.0, "nan": float("nan"), "tiny": 1e-9}[kind]
        transform.rotation = MAKE.make(
            "geometry_msgs/msg/Quaternion", x=number, y=number, z=number, w=number
        )
    return message


@pytest.mark.parametrize("kind", ["zero", "nan", "tiny", "shift"])
@pytest.mark.parametrize("topic", ["/tf_static", "/robot/tf_static", "/tf"])
def test_a_transform_that_is_none_is_left_out_and_its_frame_named(
    tmp_path: Path, kind: str, topic: str
) -> None:
    bad = Stamped(topic, TREE, START_NS, spoilt(("base", "/gps", np.eye(4)), kind))
    notes = require_guess(write_bag(tmp_path, "mcap", [*sample_messages(MAKE), bad]))
    named = [note for note in notes if f"frame 'gps' on {topic} has the translation" in note]
    assert len(named) == (topic != "/tf")  # which is not read where /tf_static suffices
    assert all(note.endswith("; it is left out") for note in named)


@pytest.mark.parametrize("frame", ["left_link", "velodyne", "left_optical"])
def test_a_sensor_that_hangs_by_a_transform_that_is_none_is_named_with_frame_and_topic(
    tmp_path: Path, frame: str
) -> None:
    edges = {child: (parent, child, T) for parent, child, T in tree_of(RIG)}
    bad = Stamped("/tf_static", TREE, START_NS, spoilt(edges.pop(frame), "zero"))
    tree = Stamped("/tf_static", TREE, START_NS, MAKE.transforms(edges.values()))
    others = without(sample_messages(MAKE), "/tf_static")
    bag = write_bag(tmp_path / "bad", "mcap", [tree, bad, *others])
    expected = rf"frame '{frame}' on /tf_static has .* and the quaternion \(0.0, 0.0, 0.0, 0.0\)"
    with pytest.raises(DatasetError, match=expected) as caught:
        load_rig(bag)
    assert "If another bag of the drive has them, give it too; else describe" in str(caught.value)
    good = Stamped("/tf_static", TREE, START_NS, sample_messages(MAKE)[0].content)
    require_guess(write_bag(tmp_path / "mended", "mcap", [good, bad, *others]))


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
@pytest.mark.parametrize("backwards", [False, True])
def test_any_bag_of_a_drive_may_have_the_transforms_and_lenses(
    tmp_path: Path, kind: str, backwards: bool
) -> None:
    middle = START_NS + int(2.5 * PERIOD_NS)
    written = sample_messages(Messages(kind))
    parts = ([m for m in written if (m.record_ns > middle) == later] for later in (False, True))
    bags = [write_bag(tmp_path / str(n), kind, part) for n, part in enumerate(parts)]
    given = bags[::-1] if backwards else bags
    notes = require_guess(given)
    frames = load_dataset(given).frames
    assert [frame.cloud_path.is_relative_to(given[0]) for frame in frames] == [True] * 3 + [
        False
    ] * 3
    assert any("/tf_static of" in note and str(bags[1]) in note for note in notes)
    assert f"{bags[1]}: /left/camera_info is that of {bags[0]}" in notes


def test_transforms_of_the_own_bag_count_first(tmp_path: Path) -> None:
    moved = tree_of(RIG)
    moved[0][2][:3, 3] += 1.0
    other = [
        Stamped("/tf_static", TREE, START_NS, MAKE.transforms(moved)),
        *sample_messages(MAKE)[1:],
    ]
    one = write_bag(tmp_path / "one", "mcap", sample_messages(MAKE))
    two = write_bag(tmp_path / "two", "mcap", other)
    options = BagOptions(beside=(two,))
    require_poses(load_rig(one, options).T_camera_lidar, RIG.T_camera_lidar, atol=1e-12)
    assert read_bag_rig(one, options).notes == ()


def repeated(tree: Any, type_: str = TREE) -> list[Stamped]:
    """The same message on /tf, ten times a second."""
    return [Stamped("/tf", type_, START_NS + n * PERIOD_NS, tree) for n in range(6)]


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_transforms_on_tf_that_never_change_are_static(tmp_path: Path, kind: str) -> None:
    make = Messages(kind)
    others = without(sample_messages(make), "/tf_static")
    edges = tree_of(RIG)
    bag = write_bag(tmp_path / "all", kind, [*others, *repeated(make.transforms(edges))])
    (note,) = [note for note in require_guess(bag) if "never change" in note]
    assert "the transforms of front_left_link, front_left_optical, " in note
    some = [Stamped("/tf_static", TREE, START_NS, make.transforms(edges[1:]))]
    both = [*some, *others, *repeated(make.transforms(edges[:1]))]
    bag = write_bag(tmp_path / "some", kind, both)
    (note,) = [note for note in require_guess(bag) if "never change" in note]
    assert "the transforms of velodyne are from /tf of" in note


def test_transforms_of_tf_before_tf2_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TREE))
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", OLD_TREE))
    monkeypatch.setitem(STORES, True, store)
    make = Messages("ros1")
    tree = store.types[OLD_TREE](transforms=make.transforms(tree_of(RIG)).transforms)
    others = without(sample_messages(make), "/tf_static")
    require_guess(write_bag(tmp_path, "ros1", [*others, *repeated(tree, OLD_TREE)]))


def test_transforms_that_move_are_not_static_and_are_named(tmp_path: Path) -> None:
    written = without(sample_messages(MAKE), "/tf_static")
    for number in range(6):
        edges = tree_of(RIG)
        edges[0][2][0, 3] += 0.01 * number  # as a LiDAR on a mast
        tree = MAKE.transforms(edges)
        written.append(Stamped("/tf", TREE, START_NS + number * PERIOD_NS, tree))
    with pytest.raises(DatasetError, match="right_link, front_right_optical.*; velodyne move on"):
        load_rig(write_bag(tmp_path, "mcap", written))


@pytest.mark.parametrize("number", [0.0, pytest.param(float("nan"), marks=pytest.mark.slow)])
def test_odometry_without_poses_is_named_and_a_few_bad_ones_are_left_out(
    tmp_path: Path, number: float
) -> None:
    def bag(name: str, is_bad: Callable[[int], bool]) -> Path:
        written, _ = messages_of_a_drive()
        for each in written:
            if each.topic == "/odom" and is_bad(each.record_ns):
                turn = each.content.pose.pose.orientation
                turn.x = turn.y = turn.z = turn.w = number
        return write_bag(tmp_path / name, "mcap", written)

    options = BagOptions(motion="odometry")
    with pytest.raises(DatasetError, match="drive_mcap: no message of /odom has a pose.*; use --m"):
        load_dataset(bag("all", lambda _: True), bag=options)
    few = bag("few", lambda record_ns: record_ns % (5 * 20_000_000) == 0)
    whole = bag("none", lambda _: False)
    frames = [load_dataset(path, bag=options).frames[1] for path in (few, whole)]
    found, expected = (frame.load_cloud()[:, :3] for frame in frames)
    assert np.abs(found - expected).max() < 5e-3  # a gap of 40 ms on the bend: 10 * 0.3 * 0.02^2


def test_the_lidar_of_a_vehicle_that_stands_does_not_move(tmp_path: Path) -> None:
    # only /tf has transforms, none changes, and the poses of frames above and below are no motion
    written = without(sample_messages(MAKE), "/tf_static")
    edges = [("odom", "base", invert(tree_of(RIG)[1][2])), *tree_of(RIG)]
    for number in range(-10, 20):
        stamp_ns = START_NS + number * PERIOD_NS
        tree = MAKE.transforms(edges)
        for each in tree.transforms:
            each.header.stamp = MAKE.header(stamp_ns, "").stamp
        written.append(Stamped("/tf", TREE, stamp_ns, tree))
    bag = write_bag(tmp_path, "mcap", sorted(written, key=lambda each: each.record_ns))
    frame = load_dataset(bag, bag=BagOptions(motion="tf")).frames[0]
    still = load_dataset(bag).frames[0]
    np.testing.assert_allclose(frame.load_cloud(), still.load_cloud(), atol=1e-5)


T_LEFT_LIDAR, T_RIGHT_LIDAR = (RIG.T_camera_lidar[n] for n in ("front_left", "front_right"))
T_RIGHT_LEFT = relative_transform(T_RIGHT_LIDAR, T_LEFT_LIDAR)


def pair(  # noqa: PLR0913
    folder: Path,
    frames: tuple[str, str],
    edges: list[tuple[str, str, Any]],
    *,
    shift: Any = T_RIGHT_LEFT[:3, 3],
    R: Any = T_RIGHT_LEFT[:3, :3],
    image: str = "image_rect",
) -> Path:
    """A bag of a pair whose second camera_info has R and a fourth column of P."""
    written = without(sample_messages(MAKE), "/tf_static")
    written = [each for each in written if each.topic == "/points"]
    for name, frame, is_second in zip(RIG.cameras, frames, (False, True), strict=False):
        camera = RIG.cameras[name]
        K, P = camera.matrix_px, np.column_stack([camera.matrix_px, np.zeros(3)])
        changed: dict[str, Any] = {"P": P.ravel(), "D": np.zeros(5)}
        if is_second:
            P[:, 3] = K @ shift
            changed |= {"R": np.asarray(R).ravel(), "P": P.ravel()}
        info = MAKE.camera_info(camera, frame, **changed)
        written.append(
            Stamped(f"/{name}/camera_info", "sensor_msgs/msg/CameraInfo", START_NS, info)
        )
        pixels = MAKE.image(np.zeros((camera.height_px, camera.width_px), np.uint8), "mono8", 0)
        written.append(Stamped(f"/{name}/{image}", "sensor_msgs/msg/Image", START_NS, pixels))
    written.append(Stamped("/tf_static", TREE, START_NS, MAKE.transforms(edges)))
    return write_bag(folder, "mcap", written)


SHARED = [("velodyne", "stereo", invert(T_LEFT_LIDAR))]


# R turns the axes of the image into those of the own frame
T_OWN_RIGHT = transform(T_RIGHT_LEFT[:3, :3].T)
FRAMES: dict[str, tuple[list[tuple[str, str, Any]], str]] = {  # of the second camera
    "stereo": (
        SHARED,
        f"front_right: P of its camera_info states a baseline of "
        f"{np.linalg.norm(T_RIGHT_LEFT[:3, 3]):.3f} m; it is added, as frame 'stereo' is at that "
        "of /front_left/camera_info"),
    "stereo_again": ([*SHARED, ("stereo", "stereo_again", np.eye(4))], "it is added, as frame"),
    "right": (
        [*SHARED, ("velodyne", "right", invert(T_OWN_RIGHT @ T_RIGHT_LIDAR))],
        "; frame 'right' is its own, so it is not added"),
}  # fmt: skip


@pytest.mark.parametrize("frame", FRAMES)
def test_the_baseline_in_P_is_added_where_the_frame_lies_at_that_of_the_first(
    tmp_path: Path, frame: str
) -> None:
    edges, said = FRAMES[frame]
    bag = pair(tmp_path, ("stereo", frame), edges)
    rig = load_rig(bag)
    np.testing.assert_allclose(rig.T_camera_lidar["front_left"], T_LEFT_LIDAR, atol=1e-12)
    np.testing.assert_allclose(rig.T_camera_lidar["front_right"], T_RIGHT_LIDAR, atol=1e-9)
    assert said in read_bag_rig(bag).notes[0]
    if frame == "stereo":
        assert [each.frame_id for each in rig.cameras.values()] == ["stereo", None]


@pytest.mark.parametrize("image", ["image_rect", "image_raw"])
def test_a_baseline_along_any_axis_parts_the_cameras_as_recorded_and_rectified(
    tmp_path: Path, image: str
) -> None:
    shift = (0.3, -0.1, 0.02)
    bag = pair(tmp_path, ("stereo", "stereo"), SHARED, shift=shift, R=np.eye(3), image=image)
    T = load_rig(bag).T_camera_lidar
    found = relative_transform(T["front_right"], T["front_left"])
    np.testing.assert_allclose(found, transform(np.eye(3), shift), atol=1e-9)
