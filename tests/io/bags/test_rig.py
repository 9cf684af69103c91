"""The rig of a bag: lenses, and transforms in the right direction."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibgraph import (
    BagOptions,
    CalibrationError,
    DatasetError,
    FileError,
    camera_from_message,
    import_rig,
    load_dataset,
    load_rig,
    rig_of_bag,
)
from calibgraph.io.bags.camera_info import lens_of
from calibgraph.io.bags.messages import Bag, Drive
from calibgraph.io.bags.rig import doubtful_axes
from calibgraph.io.bags.transforms import Transforms
from tests.conftest import SAMPLE, make_camera
from tests.io.bags.writing import (
    KINDS,
    START_NS,
    Messages,
    Stamped,
    sample_messages,
    without,
    write_bag,
)

MAKE = Messages("mcap")
TREE = "tf2_msgs/msg/TFMessage"


def shifted(x: float, y: float, z: float, R: Any = None) -> Any:
    T = np.eye(4)
    T[:3, :3] = np.eye(3) if R is None else R
    T[:3, 3] = x, y, z
    return T


@pytest.mark.parametrize("kind", KINDS)
def test_one_point_goes_through_the_tree_by_hand(tmp_path: Path, kind: str) -> None:
    # A LiDAR on a roof, 1 m ahead and 2 m above the base, turned to the left: its +x is the base's
    # +y. The camera's body 1.5 m above the base looks ahead; optical axes: right, down, forward.
    turned_left = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    optical = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    make = Messages(kind)
    edges = [
        ("base", "lidar", shifted(1.0, 0.0, 2.0, turned_left)),
        ("/base", "/body", shifted(0.5, 0.0, 1.5)),
        ("body", "optical", shifted(0.0, 0.0, 0.0, optical)),
    ]
    messages = [
        Stamped("/tf_static", TREE, START_NS + n, make.transforms([edge]))
        for n, edge in enumerate([("base", "lidar", shifted(9.0, 9.0, 9.0)), *edges])  # last counts
    ]
    transforms = Transforms(Drive(Bag(write_bag(tmp_path, kind, messages))))
    T_optical_lidar = transforms.between("optical", "lidar")
    assert T_optical_lidar is not None
    # 3 m along the LiDAR's x: (1, 3, 2) of the base, (0.5, 3, 0.5) of the body: 3 m to the left
    # (-x of the image), 0.5 m above (-y), 0.5 m ahead.
    np.testing.assert_allclose(T_optical_lidar @ [3, 0, 0, 1], [-3, -0.5, 0.5, 1], atol=1e-12)
    assert transforms.between("optical", "elsewhere") is None


def test_body_axes_in_place_of_optical_ones_are_noticed(tmp_path: Path) -> None:
    edges = [("velodyne", "eye", shifted(0.5, 0.0, -0.3))]  # x ahead, as the LiDAR's
    messages = [
        *sample_messages(MAKE)[-4:],
        Stamped("/left/camera_info", "sensor_msgs/msg/CameraInfo", START_NS,
                MAKE.camera_info(make_camera(), "eye")),
        Stamped("/tf_static", TREE, START_NS, MAKE.transforms(edges)),
    ]  # fmt: skip
    bag = write_bag(tmp_path, "mcap", messages)
    line = "left looks straight up: is the frame of its camera_info optical, z ahead and y down?"
    assert doubtful_axes(rig_of_bag(bag)) == [line]
    assert line in load_dataset(bag).notes
    assert not doubtful_axes(load_rig(SAMPLE))


def test_a_bag_is_imported_with_the_extrinsics_of_another_file(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "a", "mcap", sample_messages(MAKE))
    whole = import_rig([bag])
    for name, camera in rig_of_bag(bag).cameras.items():
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
    with pytest.raises(DatasetError, match=r"connect the LiDAR's frame 'velodyne' with the frame"):
        rig_of_bag(bag)
    bag = write_bag(tmp_path / "b", "mcap", without(messages, "/left/camera_info"))
    assert list(rig_of_bag(bag).cameras) == ["front_left", "front_right"]
    with pytest.raises(DatasetError, match=r"/left/image_raw/compressed has no camera_info beside"):
        rig_of_bag(bag, BagOptions(topics={"left": "/left/image_raw/compressed"}))
    bare = [each for each in messages if "camera_info" not in each.topic]
    with pytest.raises(DatasetError, match="no image topic with a camera_info beside it"):
        rig_of_bag(write_bag(tmp_path / "c", "mcap", bare))


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


def test_an_uncalibrated_camera_is_named() -> None:
    info = MAKE.camera_info(make_camera(), "eye", K=np.zeros(9))
    with pytest.raises(FileError, match="here: K: .* holds no focal length"):
        lens_of(info, "here", rectified=False)
