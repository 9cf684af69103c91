"""Clouds that are corrected for motion already are told from those as recorded."""

from functools import cache
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import calibgraph
from calibgraph.arrays import Array
from calibgraph.trust.corrected import TWICE, corrected_checks, corrected_clouds, corrected_twice
from factors import displace
from tests.vehicle.scenes import draw_place
from tests.vehicle.test_motion import by_azimuth, sweep, twist_at, write_consecutive

SPEED_M_S = 8.0


@cache
def swept(seed: int, speed_m_s: float) -> tuple[Array, Array]:
    """(n, 3) a cloud as a LiDAR records it from a vehicle that drives, and the times."""
    rng = np.random.default_rng(seed)
    return by_azimuth(sweep(draw_place(rng), "top", speed_m_s, rng), "top")


def raw_sweeps(speed_m_s: float) -> list[Any]:
    return [(swept(seed, speed_m_s), twist_at(speed_m_s)) for seed in range(3)]


def test_clouds_that_were_corrected_are_named():
    found = [
        ((displace(points, twist, times_s - to_s), times_s), twist)
        for ((points, times_s), twist), to_s in zip(
            raw_sweeps(SPEED_M_S), (0.0, 0.05, 0.1), strict=True
        )
    ]
    line = corrected_twice(found, "top")
    assert line.startswith("top: 3 of 3 clouds were corrected for motion before")
    assert "errs by up to 80 cm: state instant_clouds: true in --config" in line
    assert not corrected_twice(found[:1], "top"), "one is thin evidence"
    assert not corrected_twice([*found, *raw_sweeps(SPEED_M_S)], "top"), "of both kinds"


@pytest.mark.parametrize("speed_m_s", [0.0, 1.0, SPEED_M_S, 20.0])
def test_nothing_is_said_of_clouds_as_recorded(speed_m_s: float):
    assert not corrected_twice(raw_sweeps(speed_m_s), "top")


def test_nothing_is_said_where_directions_do_not_follow_from_times():
    twist, rng = twist_at(SPEED_M_S), np.random.default_rng(0)
    for times in (rng.permutation, lambda s: s // 0.0013 * 0.0013, np.zeros_like):
        found = []
        for (points, times_s), _ in raw_sweeps(SPEED_M_S):
            found.append(((displace(points, twist, times_s), times(times_s)), twist))
        assert not corrected_twice(found, "top")
    without = [((points, None), twist) for (points, _), twist in raw_sweeps(SPEED_M_S)]
    assert not corrected_twice(without, "top")


@pytest.mark.parametrize("corrected", [True, False])
def test_cameras_whose_clouds_are_corrected_twice_do_not_pass(corrected: bool, tmp_path):
    folder, twist = write_consecutive(tmp_path, 3), twist_at(5.0)
    for path in folder.glob("lidars/top/*.npy"):
        cloud = np.load(path)
        points, times_s = by_azimuth(cloud, "top")
        moved = displace(points, twist, times_s) if corrected else points
        for axis, values in zip("xyz", moved.T, strict=True):
            cloud[axis] = values
        cloud["t"] = 1e9 * times_s
        np.save(path, cloud)
    data = calibgraph.load_dataset(folder, interval_s=0.1)
    run = cast(Any, SimpleNamespace(dataset=data, guess=SimpleNamespace(cameras=["front"])))
    checks = [*corrected_checks(run)]
    assert [(name, each.name, each.status) for name, each in checks] == (
        [("front", TWICE, "WARN")] if corrected else []
    )
    stated = data.at_instants()
    assert not corrected_clouds(stated)
    recorded = np.column_stack([cloud[axis] for axis in "xyz"])
    (found,) = [f for f in stated.frames if f.cloud_path == path]
    np.testing.assert_array_equal(found.load_cloud()[:, :3], recorded)
