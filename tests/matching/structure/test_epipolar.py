from __future__ import annotations

import cv2
import numpy as np

import calibgraph
from calibgraph import Rig
from calibgraph.matching.structure.epipolar import detect_features, relative_pose_up_to_scale
from tests.conftest import SAMPLE


def test_relative_pose_is_found_of_cameras_that_overlap_and_of_no_others(truth: Rig) -> None:
    frames = calibgraph.load_dataset(SAMPLE).select("0:3").frames
    lenses = {name: c.moved_to(np.eye(4)) for name, c in truth.cameras.items()}
    images = {
        name: [detect_features(frame.load_gray(name, camera)) for frame in frames]
        for name, camera in lenses.items()
    }
    names = ("front_left", "front_right")
    found = relative_pose_up_to_scale(
        *(lenses[n] for n in names), *(images[n] for n in names), seed=0
    )
    left, right = (truth.cameras[n].T_camera_lidar for n in names)
    T = right @ np.linalg.inv(left)
    assert found is not None
    assert np.degrees(np.linalg.norm(cv2.Rodrigues(found[:3, :3] @ T[:3, :3].T)[0])) < 0.5
    assert found[:3, 3] @ T[:3, 3] > 0.99 * np.linalg.norm(T[:3, 3])
    apart = ("front_right", "left")
    for pair in (apart, apart[::-1]):
        at, of = (lenses[n] for n in pair), (images[n] for n in pair)
        assert relative_pose_up_to_scale(*at, *of, seed=0) is None
