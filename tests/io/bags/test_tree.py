"""The rig of a bag: topics, lenses, transforms, and the frames that live on in exports."""

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from calibgraph import (
    BagOptions,
    CalibrationError,
    DatasetError,
    FileError,
    MatcherErrors,
    camera_from_message,
    export_calibration,
    import_rig,
    load_calibration,
    load_dataset,
    load_rig,
    simulate_correspondences,
    solve,
)
from calibgraph.io.bags.camera_info import lens_of
from calibgraph.io.bags.messages import Bag
from calibgraph.io.bags.rig import doubtful_axes
from calibgraph.io.bags.topics import choose_topics, is_rectified
from calibgraph.io.bags.transforms import Transforms
from calibgraph.io.rig_parts import Link, find_mounts
from calibgraph.model.geometry import transform
from tests.conftest import SAMPLE, make_camera
from tests.io.bags.writing import (
    KINDS,
    START_NS,
    Messages,
    Stamped,
    sample_bag,
    sample_messages,
    structured,
    without,
    write_bag,
)

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


FRONT, REAR, D435 = "/sensing/front/colour", "/sensing/rear/colour", "/d435"
CHOSEN: dict[str, tuple[tuple[str, ...], dict[str, str]]] = {
    "as many words as make them differ": (
        (f"{FRONT}/image_raw", f"{FRONT}/camera_info", f"{REAR}/image_raw", f"{REAR}/camera_info"),
        {"front_colour": f"{FRONT}/image_raw", "rear_colour": f"{REAR}/image_raw"}),
    "as recorded before rectified": (
        ("/cam/image_rect", "/cam/image_raw/compressed", "/cam/image_raw", "/cam/camera_info"),
        {"cam": "/cam/image_raw"}),
    "compressed before rectified": (
        ("/cam/image_rect", "/cam/image_raw/compressed", "/cam/camera_info"),
        {"cam": "/cam/image_raw/compressed"}),
    "rectified": (("/cam/image_rect", "/cam/camera_info"), {"cam": "/cam/image_rect"}),
    "no depth, and no image without a lens": (
        (f"{D435}/depth/image_raw", f"{D435}/depth/camera_info", "/ouster/signal_image",
         f"{D435}/color/image_raw", f"{D435}/color/camera_info"),
        {"color": f"{D435}/color/image_raw"}),
}  # fmt: skip


@pytest.mark.parametrize("name", CHOSEN)
def test_topics_of_images_are_chosen_and_named(name: str, tmp_path: Path) -> None:
    topics, expected = CHOSEN[name]
    images = choose_topics(bag_of(tmp_path, *topics), {}).images
    assert images == expected
    assert all(is_rectified(each) == ("image_rect" in each) for each in images.values())


def test_a_rig_with_the_lens_finds_images_by_the_names_that_they_would_have(tmp_path: Path) -> None:
    bag = bag_of(tmp_path, *CHOSEN["no depth, and no image without a lens"][0])
    assert choose_topics(bag, {}, ["color", "ouster"]).images == {
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


TREE = "tf2_msgs/msg/TFMessage"


@pytest.mark.parametrize("kind", KINDS)
def test_one_point_goes_through_the_tree_by_hand(tmp_path: Path, kind: str) -> None:
    # A LiDAR on a roof, 1 m ahead and 2 m above the base, turned to the left: its +x is the base's
    # +y. The camera's body 1.5 m above the base looks ahead; optical axes: right, down, forward.
    turned_left = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    optical = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    make = Messages(kind)
    edges = [
        ("base", "lidar", transform(turned_left, [1.0, 0.0, 2.0])),
        ("/base", "/body", transform(np.eye(3), [0.5, 0.0, 1.5])),
        ("body", "optical", transform(optical)),
    ]
    before = ("base", "lidar", transform(np.eye(3), [9.0, 9.0, 9.0]))  # the last counts
    messages = [
        Stamped("/tf_static", TREE, START_NS + n, make.transforms([edge]))
        for n, edge in enumerate([before, *edges])
    ]
    transforms = Transforms([Bag(write_bag(tmp_path, kind, messages))])
    T_optical_lidar = transforms.between("optical", "lidar")
    assert T_optical_lidar is not None
    # 3 m along the LiDAR's x: (1, 3, 2) of the base, (0.5, 3, 0.5) of the body: 3 m to the left
    # (-x of the image), 0.5 m above (-y), 0.5 m ahead.
    np.testing.assert_allclose(T_optical_lidar @ [3, 0, 0, 1], [-3, -0.5, 0.5, 1], atol=1e-12)
    assert transforms.between("optical", "elsewhere") is None


def test_body_axes_in_place_of_optical_ones_are_noticed(tmp_path: Path) -> None:
    edges = [("velodyne", "eye", transform(np.eye(3), [0.5, 0.0, -0.3]))]  # x ahead, as the LiDAR's
    messages = [
        *sample_messages(MAKE)[-4:],
        Stamped("/left/camera_info", "sensor_msgs/msg/CameraInfo", START_NS,
                MAKE.camera_info(make_camera(), "eye")),
        Stamped("/tf_static", TREE, START_NS, MAKE.transforms(edges)),
    ]  # fmt: skip
    bag = write_bag(tmp_path, "mcap", messages)
    line = "left looks straight up: is the frame of its camera_info optical, z ahead and y down?"
    assert doubtful_axes(load_rig(bag)) == [line]
    assert line in load_dataset(bag).notes
    assert not doubtful_axes(load_rig(SAMPLE))


def test_a_bag_is_imported_with_the_extrinsics_of_another_file(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "a", "mcap", sample_messages(MAKE))
    whole = import_rig([bag])
    for name, camera in load_rig(bag).cameras.items():
        assert whole.cameras[name].intrinsics_px == camera.intrinsics_px
        assert whole.cameras[name].distortion == camera.distortion
        np.testing.assert_array_equal(whole.T_camera_lidar[name], camera.T_camera_lidar)
    bare = write_bag(tmp_path / "b", "mcap", without(sample_messages(MAKE), "/tf_static"))
    with pytest.raises(CalibrationError, match="no file has its T_camera_lidar"):
        import_rig([bare])
    urdf = "".join(
        f'<joint name="{n}" type="fixed"><parent link="velodyne"/><child link="{n}_optical"/>'
        f'<origin xyz="0.5 0 {k}" rpy="-1.5707963267948966 0 -1.5707963267948966"/></joint>'
        f'<link name="{n}_optical"/>'
        for k, n in enumerate(whole.cameras)
    )
    path = tmp_path / "rig.urdf"
    path.write_text(f'<robot name="r"><link name="velodyne"/>{urdf}</robot>')
    T = import_rig([bare, path]).T_camera_lidar["left"]
    np.testing.assert_allclose(T @ [3.5, 0, 2, 1], [0, 0, 3, 1], atol=1e-12)  # 3 m ahead of it


def test_what_is_missing_for_a_rig_is_named(tmp_path: Path) -> None:
    messages = sample_messages(MAKE)
    bag = write_bag(tmp_path / "a", "mcap", without(messages, "/tf_static"))
    with pytest.raises(DatasetError, match="connect the LiDAR's frame 'velodyne' with the fr"):
        load_rig(bag)
    bag = write_bag(tmp_path / "b", "mcap", without(messages, "/left/camera_info"))
    assert list(load_rig(bag).cameras) == ["front_left", "front_right"]
    with pytest.raises(DatasetError, match=r"/left/image_raw/compressed has no camera_info beside"):
        load_rig(bag, BagOptions(topics={"left": "/left/image_raw/compressed"}))
    bare = [each for each in messages if "camera_info" not in each.topic]
    with pytest.raises(DatasetError, match="no image topic with a camera_info beside it"):
        load_rig(write_bag(tmp_path / "c", "mcap", bare))


@pytest.mark.parametrize("kind", KINDS)
def test_lenses_are_named_as_in_ros(kind: str) -> None:
    make, camera = Messages(kind), make_camera()

    def content(model: str, *values: float) -> tuple[Any, Any]:
        info = make.camera_info(camera, "eye", distortion_model=model, D=np.array(values))
        lens = lens_of(info, "here", rectified=False).lens
        return lens.model, [*lens.distortion]

    assert content("equidistant", 0.1, 0.2, 0.0, 0.0) == ("fisheye", [0.1, 0.2, 0.0, 0.0])
    assert content("plumb_bob", 0.1, 0.2, 0.3, 0.4, 0.5) == ("pinhole", [0.1, 0.2, 0.3, 0.4, 0.5])
    assert content("rational_polynomial", *range(1, 9), *[0] * 6) == ("pinhole", [*range(1, 9)])
    assert content("", 0, 0, 0, 0, 0) == ("pinhole", [])
    assert content("inverse_brown_conrady", 0, 0, 0, 0, 0) == ("pinhole", [])
    with pytest.raises(FileError, match="here: lens model 'inverse_brown_conrady' is none of"):
        content("inverse_brown_conrady", 0.1)


def test_a_window_and_binning_move_the_intrinsics() -> None:
    camera = make_camera()
    roi = MAKE.make(
        "sensor_msgs/msg/RegionOfInterest", x_offset=100, y_offset=20, width=800, height=300,
        do_rectify=False,
    )  # fmt: skip
    info = MAKE.camera_info(camera, "eye", roi=roi, binning_x=2, binning_y=2)
    found = lens_of(info, "here", rectified=False).lens
    assert found.size_px == (400, 150)
    assert found.intrinsics_px.model_dump() == {"fx": 359.0, "fy": 355.0, "cx": 253.5, "cy": 82.5}


def test_rectified_images_have_the_rectified_matrix_and_axes() -> None:
    R = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    P = np.array([700.0, 0, 600, -70, 0, 700, 180, 0, 0, 0, 1, 0])
    info = MAKE.camera_info(make_camera(distortion=(0.1, 0.2, 0, 0)), "eye", R=R.ravel(), P=P)
    stated = lens_of(info, "here", rectified=True)
    found = stated.lens.intrinsics_px.model_dump()
    assert found == {"fx": 700.0, "fy": 700.0, "cx": 600.0, "cy": 180.0}
    assert stated.lens.distortion == ()
    np.testing.assert_array_equal(stated.R_image_frame, R)


def test_a_message_of_a_pairs_second_camera_counts_its_baseline_on_request() -> None:
    P = np.array([700.0, 0, 600, -70, 0, 700, 180, 14, 0, 0, 1, 0])
    info = MAKE.camera_info(make_camera(), "first", P=P)
    T = camera_from_message(info, np.eye(4), rectified=True, frame_of_first=True).T_camera_lidar
    np.testing.assert_allclose(T[:3, 3], [-0.1, 0.02, 0.0], atol=1e-12)
    assert not camera_from_message(info, np.eye(4), rectified=True).T_camera_lidar[:3, 3].any()


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return sample_bag(tmp_path_factory.mktemp("bag"), "mcap")


@pytest.fixture(scope="module")
def result(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result of the bag's rig, saved and without its bag."""
    folder = tmp_path_factory.mktemp("result")
    load_rig(bag).save(folder / "rig.yaml")
    table = simulate_correspondences(
        load_rig(SAMPLE / "reference.yaml"), frames=8, errors=MatcherErrors(outlier_share=0.1)
    )
    solve(load_rig(folder / "rig.yaml"), table).save(folder)
    return folder


IDS = {name: f"{name}_optical" for name in load_rig(SAMPLE).cameras}


@pytest.mark.parametrize("format", ["ros2-launch", "urdf", "json"])
def test_a_result_and_its_exports_name_the_frames_of_the_bag(
    result: Path, tmp_path: Path, format: str
) -> None:
    rig = load_calibration(result).rig
    assert {name: camera.frame_id for name, camera in rig.cameras.items()} == IDS
    assert rig.moved_to({"left": np.eye(4)}).cameras["left"].frame_id == "left_optical"
    path = tmp_path / "out"
    export_calibration(result, path, format, even_if_failed=True)
    text = path.read_text()
    assert "velodyne" in text
    assert all(frame in text for frame in IDS.values())
    assert "left_optical_frame" not in text


def test_the_exported_transforms_are_read_back_over_the_robots_description(
    result: Path, bag: Path, tmp_path: Path
) -> None:
    estimate = load_calibration(result).rig.T_camera_lidar
    export_calibration(load_rig(bag), tmp_path / "robot.urdf", "urdf")
    export_calibration(result, tmp_path / "lenses", "camera_info", even_if_failed=True)
    launch = tmp_path / "a.launch.xml"
    export_calibration(result, launch, "ros2-launch", even_if_failed=True)
    args = [node.get("args") or "" for node in ElementTree.parse(launch).getroot()]
    named = [f"ros2 run tf2_ros static_transform_publisher {each} &\n" for each in args]
    bare = [re.sub("--[a-z-]+ ", "", each).replace("ros2 run", "rosrun") for each in named]
    for name, lines in (("ros2.sh", named), ("ros1.sh", bare)):
        (tmp_path / name).write_text("".join(lines))
    for name in (launch.name, "ros2.sh", "ros1.sh"):
        files = [tmp_path / "robot.urdf", tmp_path / name, *(tmp_path / "lenses").glob("*.yaml")]
        found = import_rig(files, lidar_frame="velodyne")
        for camera, T in estimate.items():
            np.testing.assert_allclose(found.T_camera_lidar[camera], T, atol=1e-9)
            assert found.cameras[camera].mount is not None


MOUNTED = {  # parents by child, and what is expected to be moved
    "a drivers frames below one link": (
        {"velodyne": "base", "cam_link": "base", "rgb": "cam_link", "rgb_optical": "rgb"},
        {"rgb_optical": ("base", "cam_link")},
    ),
    "two cameras on one bar": (
        {"velodyne": "base", "bar": "base", "l": "bar", "l_opt": "l", "r": "bar", "r_opt": "r"},
        {"l_opt": ("bar", "l"), "r_opt": ("bar", "r")},
    ),
    "below the LiDAR": (
        {"link": "velodyne", "opt": "link", "direct": "velodyne"},
        {"opt": ("velodyne", "link"), "direct": None},
    ),
    "the LiDAR below the camera": ({"velodyne": "opt"}, {"opt": None}),
    "one frame for two": ({"velodyne": "base", "opt": "base"}, {"opt": None, "opt ": None}),
}


@pytest.mark.parametrize("name", MOUNTED)
def test_the_link_that_moves_is_the_uppermost_of_the_camera_alone(name: str) -> None:
    parents, expected = MOUNTED[name]
    cameras = {camera: (camera.strip(), np.eye(4)) for camera in expected}
    links = {child: Link(parent, child, np.eye(4)) for child, parent in parents.items()}
    found = find_mounts(cameras, "velodyne", links)
    moved = {n: (found[n].parent, found[n].child) if n in found else None for n in expected}
    assert moved == expected
