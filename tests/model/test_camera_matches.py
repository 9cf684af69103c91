from __future__ import annotations

from dataclasses import FrozenInstanceError
from typing import Any

import numpy as np
import pytest

from calibgraph import CorrespondenceError
from calibgraph.model.camera_matches import CameraMatches, concatenate_camera_matches
from tests.model.tables import CAMERAS, NAN, camera_matches


def with_entry(name: str, place: tuple[int, ...], value: float) -> dict[str, Any]:
    """A column of the good table with one wrong entry."""
    column = getattr(camera_matches(), name).copy()
    column[place] = value
    return {name: column}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (with_entry("pixels_px", (1, 0, 0), NAN), "row 1: pixel must be finite"),
        (with_entry("pixels_px", (2, 1, 0), 1e7), "row 2: pixel"),
        (with_entry("planes_lidar_per_m", (0, 1, 2), NAN), "row 0: planes_lidar_per_m"),
        (with_entry("planes_lidar_per_m", (0, 1, 2), np.inf), "row 0: planes_lidar_per_m"),
        ({"planes_lidar_per_m": np.zeros((3, 2, 3))}, "not zero"),
        (with_entry("camera_index", (1, 0), 1), "row 1: camera_index .*A before B"),
        (with_entry("camera_index", (1, 0), -1), "row 1: camera_index"),
        (with_entry("camera_index", (2, 1), 3), "row 2: camera_index"),
        ({"frame": np.array([1, 2])}, "shape"),
    ],
)
def test_bad_values_are_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(CorrespondenceError, match=message):
        camera_matches(**changes)


def test_pairs_are_listed_and_selected() -> None:
    table = camera_matches()
    assert table.pairs() == [("left", "right"), ("right", "rear")]
    assert table.of_pair("left", "right").frame.tolist() == [4, 5]
    assert len(table.of_pair("right", "left")) == len(table.of_pair("left", "nobody")) == 0
    assert repr(table) == "CameraMatches(left-right: 2, right-rear: 1; 2 frames)"


def test_tables_are_put_under_each_other() -> None:
    table = camera_matches()
    joined = concatenate_camera_matches([CameraMatches.empty(CAMERAS), table, table.select([2])])
    assert joined.frame.tolist() == [4, 5, 5, 5]
    with pytest.raises(ValueError, match="same cameras"):
        concatenate_camera_matches([table, CameraMatches.empty(("a", "b"))])


def test_a_table_is_immutable() -> None:
    table = camera_matches()
    with pytest.raises(FrozenInstanceError):
        table.frame = table.frame
    with pytest.raises(ValueError, match="read-only"):
        table.pixels_px[0] = 0
    assert not table.with_planes(np.ones((3, 2, 3))).planes_lidar_per_m.flags.writeable
