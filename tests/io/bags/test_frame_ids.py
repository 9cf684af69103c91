"""The frames of a bag live on in the rig, the result and what is exported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibgraph import (
    MatcherErrors,
    export_calibration,
    import_rig,
    load_calibration,
    load_rig,
    rig_of_bag,
    simulate_correspondences,
    solve,
)
from calibgraph.io.mounts import find_mounts
from calibgraph.model.geometry import invert
from tests.conftest import SAMPLE
from tests.io.bags.writing import (
    sample_bag,
    tree_of,
)
from tests.io.formats.readers import READERS


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return sample_bag(tmp_path_factory.mktemp("bag"), "mcap")


@pytest.fixture(scope="module")
def result(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result of the bag's rig, saved and without its bag."""
    folder = tmp_path_factory.mktemp("result")
    rig_of_bag(bag).save(folder / "rig.yaml")
    table = simulate_correspondences(
        load_rig(SAMPLE / "reference.yaml"), frames=8, errors=MatcherErrors(outlier_share=0.1)
    )
    solve(load_rig(folder / "rig.yaml"), table).save(folder)
    return folder


IDS = {name: f"{name}_optical" for name in load_rig(SAMPLE).cameras}


def test_a_result_has_the_frames_of_its_bag(result: Path) -> None:
    rig = load_calibration(result).rig
    assert rig.lidar == "velodyne"
    assert {name: camera.frame_id for name, camera in rig.cameras.items()} == IDS
    moved = rig.moved_to({"left": np.eye(4)})
    assert moved.cameras["left"].frame_id == "left_optical"


@pytest.mark.parametrize("format", ["ros1", "ros2", "ros2-launch", "tf2", "urdf", "json"])
def test_an_export_names_the_frames_of_the_bag(result: Path, tmp_path: Path, format: str) -> None:
    path = tmp_path / "out"
    export_calibration(result, path, format, even_if_failed=True)
    text = path.read_text()
    assert "velodyne" in text
    assert all(frame in text for frame in IDS.values())
    assert "left_optical_frame" not in text
    export_calibration(
        result, path, format, camera_frame="cam/{camera}", lidar_frame="top", even_if_failed=True,
        force=True,
    )  # fmt: skip
    chosen = path.read_text()
    assert "cam/left" in chosen
    assert "velodyne" not in chosen
    assert "left_optical" not in chosen


EDGES = {child: (parent, T) for parent, child, T in tree_of(load_rig(SAMPLE))}


def in_base(tree: dict[str, tuple[str, Any]], frame: str) -> Any:
    """(4, 4) of a frame in the root, link by link."""
    T = np.eye(4)
    while frame in tree:
        frame, T_parent_child = tree[frame]
        T = T_parent_child @ T
    return T


@pytest.mark.parametrize("format", ["ros1", "ros2", "ros2-launch", "tf2"])
def test_the_exported_transforms_replace_those_of_the_robots_tree(
    result: Path, tmp_path: Path, format: str
) -> None:
    estimate = load_calibration(result).rig.T_camera_lidar
    export_calibration(result, tmp_path / "out", format, even_if_failed=True)
    T_base_link = READERS[format](tmp_path / "out")
    assert T_base_link.keys() == {f"{name}_link" for name in IDS}
    changed = {link: ("base", invert(T)) for link, T in T_base_link.items()}
    tree = {**EDGES, **changed}  # as tf has it, with one parent for each frame
    assert tree.keys() == EDGES.keys()
    for name, frame in IDS.items():
        T_camera_lidar = invert(in_base(tree, frame)) @ in_base(tree, "velodyne")
        np.testing.assert_allclose(T_camera_lidar, estimate[name], atol=1e-9)


def test_the_exported_transforms_are_read_back_over_the_robots_description(
    result: Path, bag: Path, tmp_path: Path
) -> None:
    estimate = load_calibration(result).rig.T_camera_lidar
    export_calibration(rig_of_bag(bag), tmp_path / "robot.urdf", "urdf")
    export_calibration(result, tmp_path / "lenses", "camera_info", even_if_failed=True)
    for format, name in (("ros2-launch", "a.launch.xml"), ("ros1", "b.sh"), ("ros2", "c.sh")):
        export_calibration(result, tmp_path / name, format, even_if_failed=True)
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
    found = find_mounts(cameras, "velodyne", parents, lambda *_: np.eye(4))
    moved = {n: (found[n].parent, found[n].child) if n in found else None for n in expected}
    assert moved == expected
