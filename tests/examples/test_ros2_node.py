"""The ROS 2 node without ROS: messages of rosbags, and a stand-in for rclpy."""

import logging
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import calibgraph
from calibgraph import Calibration, Dataset, Verdict, load_dataset, load_rig
from examples.ros2_node import Calibrator, Recording, fill_transform, matrix_of
from tests.conftest import SAMPLE
from tests.io.bags.writing import Messages, Stamped, require_same_frames, sample_messages

MAKE = Messages("mcap")
S = 1_000_000_000


def received(topic: str, messages: list[Stamped]) -> list[Any]:
    return [each.content for each in messages if each.topic == topic]


class StandIn:
    """The parts of ROS: transforms from a rig, and what was published."""

    def __init__(self) -> None:
        self.rig = load_rig(SAMPLE)
        self.log = logging.getLogger("node")
        self.published: list[Any] = []

    def lookup(self, target: str, source: str) -> Any:
        assert source == "velodyne"
        T = self.rig.T_camera_lidar[target.removesuffix("_optical")]
        return MAKE.transforms([(target, source, T)]).transforms[0]

    def new_transform(self) -> Any:
        names = {"translation": SimpleNamespace(), "rotation": SimpleNamespace()}
        return SimpleNamespace(header=SimpleNamespace(), transform=SimpleNamespace(**names))

    def publish(self, transforms: list[Any]) -> None:
        self.published = transforms


@pytest.fixture
def calibrator(monkeypatch: pytest.MonkeyPatch) -> Calibrator:
    """After the sample's messages; a calibration returns the dataset that it was given."""
    monkeypatch.setattr(calibgraph, "calibrate", lambda data: data)
    monkeypatch.setattr(Calibrator, "_finish", lambda *_: None)
    messages = sample_messages(MAKE)
    names = list(load_rig(SAMPLE).cameras)
    node = Calibrator(Recording(every_s=0.1, frames=6), names, StandIn())
    for name in names:
        (info,) = received(f"/{name}/camera_info", messages)
        node.receive_info(name, info)
    images = [received(f"/{name}/image_raw/compressed", messages) for name in names]
    for together in zip(received("/points", messages), *images, strict=True):
        node.receive_frame(*together)
    return node


def test_the_frames_are_those_of_the_folder(calibrator: Calibrator) -> None:
    assert calibrator.running is not None
    data, folder = calibrator.running.result(), load_dataset(SAMPLE)
    assert isinstance(data, Dataset)
    assert len(data.frames) == len(folder.frames)
    for name, camera in folder.rig.cameras.items():
        found = data.rig.cameras[name]
        assert found.intrinsics_px == camera.intrinsics_px
        np.testing.assert_allclose(found.T_camera_lidar, camera.T_camera_lidar, atol=1e-12)
    require_same_frames(data, folder)


def test_a_published_pose_has_the_lidar_as_its_parent() -> None:
    pose = np.linalg.inv(load_rig(SAMPLE).T_camera_lidar["left"])
    message = fill_transform(StandIn().new_transform(), pose, "velodyne", "left_optical")
    assert (message.header.frame_id, message.child_frame_id) == ("velodyne", "left_optical")
    np.testing.assert_allclose(matrix_of(message.transform), pose, atol=1e-12)


def test_only_a_result_that_did_not_fail_is_published() -> None:
    table = calibgraph.simulate_correspondences(load_rig(SAMPLE), frames=6, matches=100)
    result = calibgraph.solve(load_rig(SAMPLE), table)
    assert result.verdict.status != "FAIL"
    assert published(result) == ["front_left_optical", "front_right_optical", "left_optical"]
    check = calibgraph.Check("any", "FAIL", "wrong")
    bad = replace(result, camera_verdicts=dict.fromkeys(result.rig.cameras, Verdict((check,))))
    assert published(bad) == []


def published(result: Calibration) -> list[str]:
    node = Calibrator(
        Recording(1.0, 6, lidar_frame="velodyne"), list(result.rig.cameras), StandIn()
    )
    for name in result.rig.cameras:
        header = SimpleNamespace(frame_id=f"{name}_optical")
        node.receive_info(name, SimpleNamespace(header=header))
    done = SimpleNamespace(exception=lambda: None, result=lambda: result)
    node._finish(done)
    return [each.child_frame_id for each in node.ros.published]
