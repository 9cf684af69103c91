from __future__ import annotations

import numpy as np
import pytest

import calibgraph
from calibgraph import Rig
from calibgraph.matching.structure.common_features import CommonFeatures
from calibgraph.matching.structure.frame_cache import FrameCache, load_camera_frames
from calibgraph.model.geometry import pose_difference
from calibgraph.parallel import core_pool
from tests.conftest import SAMPLE

OVERLAP, APART = ("front_left", "front_right"), ("front_right", "left")


@pytest.fixture(scope="module")
def common(truth: Rig) -> CommonFeatures:
    """Of the sample's cameras, without their extrinsics."""
    lenses = truth.moved_to(dict.fromkeys(truth.cameras, np.eye(4)))
    frames = calibgraph.load_dataset(SAMPLE).select("0:3").frames
    with core_pool() as cores:
        loaded = load_camera_frames(FrameCache(), frames, lenses, cores)
        found = CommonFeatures(lenses, loaded, seed=0)
    return found


@pytest.mark.parametrize("names", [OVERLAP, OVERLAP[::-1]])
def test_a_camera_is_placed_where_another_one_sees_it(
    common: CommonFeatures, truth: Rig, names: tuple[str, str]
) -> None:
    T = truth.T_camera_lidar
    placed = common.place(names[0], names[1], T[names[1]])
    assert placed is not None
    degrees, centimetres = pose_difference(placed, T[names[0]])
    assert degrees < 0.5 and centimetres < 15.0  # the reach of a refinement is far more


@pytest.mark.parametrize("names", [APART, APART[::-1]])
def test_cameras_that_see_nothing_in_common_place_nothing(
    common: CommonFeatures, truth: Rig, names: tuple[str, str]
) -> None:
    assert common.place(names[0], names[1], truth.T_camera_lidar[names[1]]) is None
