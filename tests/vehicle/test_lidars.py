"""LiDARs by planes: the truth, error bars, what is flat, what moved, what does not overlap."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError
from calibgraph.matching.cloud_similarity import find_upright
from calibgraph.model.geometry import transform
from calibgraph.model.verdict import TOLERANCE
from calibgraph.vehicle.lidars import (
    PLACE_SIGMAS,
    LidarPoses,
    calibrate_lidars,
    combine_places,
)
from calibgraph.vehicle.planes import find_planes, look
from calibgraph.vehicle.rig import judge_lidar
from calibgraph.vehicle.start import locate_lidars
from tests.vehicle.scenes import (
    HEIGHT_M,
    MOUNTS,
    displaced,
    draw_place,
    flat_street,
    record,
    scan,
)

UPSIDE_DOWN = transform(
    Rotation.from_euler("xyz", [180.0, 10.0, 30.0], degrees=True), [1.0, 0.3, 0.0]
)


TWO = {name: MOUNTS[name] for name in ("top", "left")}


def errors(found: LidarPoses, name: str, truth: Array) -> Array:
    """(6,) of the result, as its covariance has them."""
    T = found.T_base_lidar[name]
    rotation = Rotation.from_matrix(T[:3, :3] @ truth[:3, :3].T).as_rotvec()
    return np.concatenate([rotation, T[:3, 3] - truth[:3, 3]])


def sigmas(found: LidarPoses, name: str) -> Array:
    return np.sqrt(np.diag(found.covariance[name]))


@pytest.mark.usefixtures("few_placements")
def test_poses_are_found_without_a_guess_upside_down_too():
    clouds = record(1, places=2, mounts={"top": MOUNTS["top"], "down": UPSIDE_DOWN})
    start, doubts, _ = locate_lidars(look(clouds), {"down": None}, base="top")
    assert not doubts
    found = calibrate_lidars(look(clouds), start, base="top")
    off = np.abs(errors(found, "down", UPSIDE_DOWN))
    # wanted of ten places: 0.02 deg, 0.4 cm
    assert off[:3].max() < np.radians(0.02) and off[3:].max() < 0.004
    assert (off < 3 * sigmas(found, "down")).all()
    assert found.matched["down"] > 0.95


def test_what_a_lidar_adds_to_ranges_widens_the_bar_where_it_looks_one_way():
    turn = Rotation.from_euler("zyx", [4.0, 3.0, 1.0], degrees=True)
    ahead = {"top": MOUNTS["top"], "ahead": transform(turn, [2.2, 0.1, -1.0])}
    clouds = record(201, places=6, mounts=ahead)
    for number, cloud in enumerate(clouds["ahead"]):
        seen = cloud[np.abs(np.arctan2(cloud[:, 1], cloud[:, 0])) < np.radians(20.0)]
        ranges = np.linalg.norm(seen, axis=1, keepdims=True)
        clouds["ahead"][number] = seen * (1.0 + 0.02 / ranges)
    found = calibrate_lidars(look(clouds), ahead, base="top")
    bar = sigmas(found, "ahead")
    assert bar[3] > 0.01, "as the clouds are, 0.8 cm, 2 cm off"
    assert (np.abs(errors(found, "ahead", ahead["ahead"])) < 3 * bar).all()


def test_a_flat_street_leaves_the_direction_along_it_open():
    clouds = record(3, places=1, beams=12, street=True)
    guess = {name: displaced(MOUNTS[name], 4, 0.5, 0.05) for name in ("front", "left")}
    found = calibrate_lidars(look(clouds), guess, base="top")
    for name in ("front", "left"):
        bar = sigmas(found, name)
        assert bar[3] > 0.3, "along the street nothing is known"
        assert (bar[4:] < 0.02).all() and (bar[:3] < np.radians(0.15)).all()
        off = np.abs(errors(found, name, MOUNTS[name]))
        assert (off < 3 * bar).all()
        verdict = judge_lidar(found, name, TOLERANCE)
        assert verdict.status == "WARN" and verdict.cannot_tell
        assert "determines x in top: the guess stays" in " ".join(verdict.reasons)


@pytest.mark.parametrize("with_guess", [False, True])
def test_in_a_room_that_looks_alike_from_both_ends_a_pose_without_a_guess_is_no_pass(with_guess):
    rng, at = np.random.default_rng(10), transform(np.eye(3), [0.0, 0.0, HEIGHT_M])
    walls = np.array([[[s * 12.0 - 1.0, -8.0, 0.0], [s * 12.0 + 1.0, 8.0, 7.0]] for s in (-1, 1)])
    clouds = {
        name: [scan(np.concatenate([walls, walls[:, :, [1, 0, 2]]]), at @ MOUNTS[name], rng)]
        for name in ("top", "front")
    }
    guess = displaced(MOUNTS["front"], 11, 10.0, 0.3) if with_guess else None
    start, doubts, _ = locate_lidars(look(clouds), {"front": guess}, base="top")
    verdict = judge_lidar(
        calibrate_lidars(look(clouds), start, base="top"), "front", TOLERANCE,
        doubt=doubts.get("front", ""),
    )  # fmt: skip
    if with_guess:
        off = start["front"] - MOUNTS["front"]
        assert not doubts and np.abs(off).max() < 0.05
    else:
        assert "turned by 180 deg" in doubts["front"]
        assert verdict.status == "WARN" and verdict.cannot_tell
        assert "it fits as well" in " ".join(verdict.reasons)


def test_a_wall_that_holds_more_points_than_the_ground_is_not_taken_for_it():
    rng, T = np.random.default_rng(12), transform(np.eye(3), [0.0, 5.0, HEIGHT_M])
    cloud = scan(flat_street(), T, rng)
    returned = (cloud[:, 2] > 0.1 - HEIGHT_M) | (rng.random(len(cloud)) < 0.4)  # wet asphalt
    found = find_upright("top", [cloud[returned]])
    np.testing.assert_allclose(found[2], [0.0, 0.0, 1.0, HEIGHT_M], atol=0.05)


@pytest.mark.parametrize("lidars", [1, 2])
@pytest.mark.parametrize("places", [1, 3, 10])
def test_errors_over_bars_are_one_where_places_scatter_as_their_prior(lidars, places):
    rng, sizes, squares = np.random.default_rng(13), np.tile(PLACE_SIGMAS, lidars), []
    for _ in range(300):
        drawn = []
        for _ in range(places):
            root = 0.1 * sizes[:, None] * rng.normal(size=(6 * lidars,) * 2)
            information = np.linalg.inv(root @ root.T + np.diag((0.05 * sizes) ** 2))
            noise = np.linalg.cholesky(np.linalg.inv(information)) @ rng.normal(size=6 * lidars)
            drawn.append((information, information @ (sizes * rng.normal(size=6 * lidars) + noise)))
        step, covariance, _ = combine_places(drawn, PLACE_SIGMAS, np.empty(0))
        squares.append(step @ np.linalg.solve(covariance, step) / (6 * lidars))
    # the mean of 1800 squares of normal numbers has a deviation of sqrt(2 / 1800) = 0.03; sizes
    # that are common to a recording double it
    assert 0.87 < np.mean(squares) < 1.13


def test_places_that_differ_widen_the_error_bar_and_places_that_agree_narrow_it():
    turn, shift = PLACE_SIGMAS[0], PLACE_SIGMAS[3]
    ratios = {}
    for factor in (0.0, 2.0):
        clouds = record(5, places=3, mounts=TWO, beams=12, scatter=(factor * turn, factor * shift))
        found = calibrate_lidars(look(clouds), TWO, base="top")
        ratios[factor] = found.place_ratios
        off = np.abs(errors(found, "left", MOUNTS["left"]))
        assert (off < 3.5 * sigmas(found, "left")).all(), factor
    for kind in (0, 1):
        assert ratios[0.0][kind] < 0.3 and ratios[2.0][kind] > 2.0


def test_instants_in_which_the_vehicle_stands_count_once():
    rng, boxes = np.random.default_rng(9), draw_place(np.random.default_rng(1))
    ats = [transform(np.eye(3), [x, 0.0, HEIGHT_M]) for x in (0.0, 0.0, 5.0, 0.0)]
    clouds = {
        n: [scan(boxes, at @ MOUNTS[n], rng, beams=12) for at in ats] for n in ("top", "front")
    }
    assert calibrate_lidars(look(clouds), MOUNTS, base="top").places == 2


def test_a_lidar_that_moved_between_places_shows_in_what_places_differ_by():
    T = MOUNTS["left"].copy()
    T[1, 3] += 0.15
    clouds = record(6, places=2, mounts=TWO, beams=12, moved={"left": T})
    found = calibrate_lidars(look(clouds), TWO, base="top")
    assert found.place_ratios[1] > 2.0**2  # the limit of PASS, as a variance


@pytest.mark.usefixtures("few_placements")
def test_clouds_that_share_nothing_are_refused_with_their_share():
    clouds, rng = record(7, places=1, beams=12), np.random.default_rng(8)
    elsewhere = draw_place(rng, boxes=6, fronts=False)
    at = transform(np.eye(3), [0.0, 0.0, HEIGHT_M])
    clouds["left"] = [scan(elsewhere, at @ MOUNTS["left"], rng, beams=12)]
    found, _, lost = locate_lidars(look(clouds), {"front": None, "left": None}, base="top")
    assert [*found] == ["front"] and re.match(r"LiDAR 'left' shares too little with top.*%", lost)
    clouds["left"] = [np.array([[5.0, y, z] for y in range(9) for z in range(9)])]
    with pytest.raises(CalibrationError, match="LiDAR 'left' sees no ground"):
        locate_lidars(look(clouds), {"front": None, "left": None}, base="top")
    with pytest.raises(CalibrationError, match="'left' sees 0 planes that others see"):
        calibrate_lidars(look(clouds), MOUNTS, base="top")


@pytest.mark.usefixtures("few_placements")
def test_a_lidar_without_ground_near_it_is_placed_by_its_guess():
    clouds = record(2, places=1, mounts=TWO)
    clouds["top"] = [of[np.linalg.norm(of, axis=1) > 15.0] for of in clouds["top"]]
    guess = {"left": displaced(MOUNTS["left"], 3, 3.0, 0.1)}
    views = look(clouds)
    start, _, lost = locate_lidars(views, guess, base="top")
    assert not lost
    found = calibrate_lidars(views, start, base="top")
    off = np.abs(errors(found, "left", MOUNTS["left"]))
    assert off[:3].max() < np.radians(0.2) and (off < 4 * sigmas(found, "left")).all()


def test_planes_without_any_noise_are_no_failure():
    two = {name: MOUNTS[name] for name in ("top", "front")}
    at, rng = transform(np.eye(3), [0.0, 0.0, HEIGHT_M]), np.random.default_rng(0)
    clouds = {
        name: [scan(np.empty((0, 2, 3)), at @ T, rng, noise_m=0.0)] for name, T in two.items()
    }
    bar = sigmas(calibrate_lidars(look(clouds), two, base="top"), "front")
    assert (bar[[0, 1, 5]] < [0.01, 0.01, 0.1]).all() and (bar[2:5] > [0.1, 0.5, 0.5]).all()


def test_the_centre_of_a_plane_lies_on_it_and_single_rings_are_no_planes():
    rng = np.random.default_rng(0)
    cloud = scan(flat_street(), transform(np.eye(3), [0.0, 0.0, 1.8]), rng, noise_m=0.0)
    planes = find_planes(cloud)
    ground = np.abs(planes["normal"][:, 2]) > 0.9
    assert ground.any() and not ground.all()
    _, y, z = planes["center_m"].T
    off = np.abs(z + 1.8), np.abs(np.abs(y) - 8.0)
    assert np.mean(np.minimum(*off) < 1e-6) > 0.9, "but for those in the corner of both"
    ring = np.column_stack(
        [*(5 * f(np.linspace(0, 6, 500)) for f in (np.cos, np.sin)), -np.ones(500)]
    )
    assert not len(find_planes(ring))


@pytest.mark.slow
@pytest.mark.statistics
def test_error_bars_are_as_wide_as_errors_scatter():
    turn, shift = PLACE_SIGMAS[0], PLACE_SIGMAS[3]
    nees = []
    for seed in range(12):
        clouds = record(100 + seed, places=5, scatter=(turn, shift))
        found = calibrate_lidars(look(clouds), MOUNTS, base="top")
        for name in ("front", "left"):
            off = errors(found, name, MOUNTS[name])
            nees.append(off @ np.linalg.solve(found.covariance[name], off) / 6)
    # the mean of 144 squares has a deviation of sqrt(2 / 144) = 0.12, and sizes are estimated
    assert 0.6 < np.mean(nees) < 1.5
