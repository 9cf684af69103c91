"""The parts of the search: bodies, common features, correlation maps, the box about a guess."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import calibgraph
from calibgraph import Rig
from calibgraph.matching.structure.bodies import adjoint, lead, place, place_member, rigid_bodies
from calibgraph.matching.structure.box_search import BodyMaps, Box, search_box
from calibgraph.matching.structure.common_features import CommonFeatures
from calibgraph.matching.structure.correlation_maps import CorrelationMaps
from calibgraph.matching.structure.directions import view_angles
from calibgraph.matching.structure.frame_cache import FrameCache, load_camera_frames
from calibgraph.model.geometry import pose_difference
from calibgraph.parallel import core_pool
from calibgraph.solver.columns import apply_twist
from tests.conftest import SAMPLE, make_camera, stereo_relative_pose


@pytest.fixture
def names(truth: Rig) -> list[str]:
    return list(truth.cameras)


def test_tight_relative_poses_join_cameras_whatever_their_direction(
    truth: Rig, names: list[str]
) -> None:
    a, b, c = names
    pairs = stereo_relative_pose(truth, c, b), stereo_relative_pose(truth, b, a)
    rig = truth.model_copy(update={"relative_poses": pairs})
    (body,) = rigid_bodies(rig.moved_to({b: np.eye(4), c: np.eye(4)}))
    assert list(body)[0] == a
    for name in names:
        np.testing.assert_allclose(body[name].T_camera_lidar, truth.T_camera_lidar[name], atol=1e-9)


def test_a_moved_body_keeps_its_relative_poses(truth: Rig, names: list[str]) -> None:
    pairs = tuple(stereo_relative_pose(truth, names[0], name) for name in names[1:])
    (body,) = rigid_bodies(truth.model_copy(update={"relative_poses": pairs}))
    twist = np.array([1e-4, -2e-4, 1e-4, 2e-3, 1e-3, -1e-3])
    moved = place(body, apply_twist(lead(body), twist).T_camera_lidar)
    for name in names:
        own = apply_twist(body[name], adjoint(body, name) @ twist).T_camera_lidar
        np.testing.assert_allclose(moved[name].T_camera_lidar, own, atol=2e-6)
        again = place_member(body, name, moved[name].T_camera_lidar)
        for other in names:
            np.testing.assert_allclose(
                again[other].T_camera_lidar, moved[other].T_camera_lidar, atol=1e-9
            )


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


@pytest.mark.slow
def test_the_search_finds_where_the_maps_agree() -> None:
    """Groups whose maps have one peak each: half where the true pose puts them, half anywhere."""
    rng = np.random.default_rng(1)
    points = rng.uniform([5, -15, -2], [40, 15, 4], (600, 3))
    true = make_camera((0.3, 0.1, -0.1)).T_camera_lidar
    step, origin, shape = np.radians(0.6), np.radians([-41.0, -15.0]), (50, 137)
    place = (view_angles(points @ true[:3, :3].T + true[:3, 3]) - origin) / step
    outlier = rng.random(600) < 0.5
    place[outlier] = rng.uniform(0, shape[::-1], (np.count_nonzero(outlier), 2))
    v, u = np.mgrid[: shape[0], : shape[1]]
    squares = (u - place[:, 0, None, None]) ** 2 + (v - place[:, 1, None, None]) ** 2
    maps = np.exp(-0.5 * squares / 2.0**2).astype(np.float32)
    maps -= maps.mean(axis=(1, 2), keepdims=True)
    correlation = CorrelationMaps(maps, points, origin, step)
    body = BodyMaps([correlation], [np.eye(4)])
    guess = Box(true, np.radians(20), 1.5).transforms(rng.uniform(-1, 1, (1, 6)) * 0.3)[0]
    box = Box(guess, np.radians(20), 1.5)
    with core_pool() as cores:
        found = search_box(body, box, cores, seed=0)
    off = Box(true, 1.0, 1.0).displacements(found[0][None])[0]
    assert np.abs(off[:3]).max() < np.radians(0.6)  # a step of the maps
    assert np.abs(off[3:]).max() < 0.15  # a step at 15 m
    with ThreadPoolExecutor(1) as alone:
        again = search_box(body, box, alone, seed=0)
    np.testing.assert_array_equal(again, found)  # whatever the number of threads
