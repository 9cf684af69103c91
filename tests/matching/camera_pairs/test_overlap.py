"""Which cameras can see something in common."""

from __future__ import annotations

import numpy as np

import calibgraph
from calibgraph import Rig
from calibgraph.matching.camera_pairs import overlapping_pairs
from tests.conftest import SAMPLE, make_camera


def test_the_front_cameras_of_the_sample_overlap() -> None:
    truth = calibgraph.load_rig(SAMPLE / "reference.yaml")
    cloud = calibgraph.load_dataset(SAMPLE, truth).frames[0].load_cloud()
    pairs = overlapping_pairs(truth, cloud)
    assert ("front_left", "front_right") in pairs
    assert all(a != b and list(truth.cameras).index(a) < list(truth.cameras).index(b)
               for a, b in pairs)  # fmt: skip


def test_cameras_back_to_back_do_not(pair: Rig) -> None:
    ahead = pair.cameras["left"]
    turn = np.diag([-1.0, 1.0, -1.0, 1.0])  # half a turn about the camera's y axis
    rig = Rig(cameras={"ahead": ahead, "back": ahead.moved_to(turn @ ahead.T_camera_lidar)})
    rng = np.random.default_rng(0)
    cloud = rng.uniform(-30, 30, (5000, 4)).astype(np.float32)
    assert overlapping_pairs(rig, cloud) == []
    assert overlapping_pairs(Rig(cameras={"only": make_camera()}), cloud) == []
