from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from calibgraph import CorrespondenceError
from tests.model.tables import NAN, camera_matches


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
