"""Tables of matches with points and between cameras: bad values are named, joined tables."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from calibgraph import CorrespondenceError, concatenate
from tests.model.tables import NAN, camera_matches, table


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pixels_px": [[np.nan, 1]] * 4}, r"row 0 \(camera 'left', frame 0\): pixel"),
        ({"points_lidar_m": [[1, 2, np.inf]] * 4}, "point must be finite"),
        ({"confidence": [0.5, 0, 1, 1]}, r"row 1 .*confidence must lie in \(0, 1\]"),
        ({"confidence": [0.5, np.nan, 1, 1]}, "confidence"),
        ({"information_px": [[1, 2, 1]] * 4}, "positive semidefinite"),
        ({"information_px": [[0, 0, 0]] * 4}, "not zero"),
        ({"pixels_px": [[1e308, 1]] * 4}, "pixel must be finite and below"),
        ({"information_px": [[1e200, 2e200, 1e200]] * 4}, "information must be finite and below"),
        ({"information_px": [[1e-200, 2e-200, 1e-200]] * 4}, "positive semidefinite"),
        ({"frame": [0.5, 1, 1, 1]}, "frame must hold whole numbers"),
        ({"metadata": [1]}, "metadata must be a mapping"),
        (
            {"metadata": {"systematic_rotation_rad": 10**400}},
            "systematic_rotation_rad: Input should be a valid number, found 10.*[.]{3}",
        ),
        ({"metadata": {"range_rotation_deg": "20"}}, "range_rotation_deg: .* valid number"),
        ({"metadata": {"range_translation_m": math.nan}}, "less than or equal to 100, found nan"),
        ({"metadata": {"systematic_translation_m": "1"}}, "found '1'"),
        ({"metadata": {"found": {"left": 10**400}}}, "found.left: Input should be a valid number"),
        ({"metadata": {"stage1": None}}, "stage1"),
        ({"metadata": {"missed": {"left": math.nan}}}, "missed.left: .* finite number, found nan"),
        ({"points_lidar_m": [[1, 2]] * 4}, r"shape \(4, 2\), expected \(4, 3\)"),
        ({"confidence": [1.0]}, "shape"),
    ],
)
def test_bad_values_are_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(CorrespondenceError, match=message):
        table(**changes)


def test_concatenating_keeps_rows_and_fills_information() -> None:
    one = table()
    two = table(camera="rear", information_px=[[4, 0, 1]] * 4)
    joined = concatenate([one, two])
    assert joined.counts() == {"left": 3, "rear": 4, "right": 1}
    assert joined.information_px[0].tolist() == [1, 0, 1]
    assert joined.information_px[-1].tolist() == [4, 0, 1]
    assert len(joined.of_camera("rear")) == 4
    assert len(joined.of_camera("nobody")) == 0


def test_a_common_error_is_stated_if_all_joined_tables_state_it_as_the_largest() -> None:
    none, small, large = (
        table(metadata={"systematic_rotation_rad": r, "systematic_translation_m": t})
        for r, t in ((0.0, 0.0), (0.002, 0.01), (0.001, 0.05))
    )
    assert concatenate([none, small, large]).findings.systematic_sigmas == (0.002, 0.05)
    assert concatenate([none, none]).findings.states_common_error
    for unstated in (table(), table(metadata={"matcher": "mine"})):
        assert not concatenate([none, unstated]).findings.states_common_error
        assert not concatenate([unstated, none]).findings.states_common_error
    without_rows = table().select(slice(0))
    assert concatenate([without_rows, small]).findings.systematic_sigmas == (0.002, 0.01)


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
def test_bad_values_of_camera_matches_are_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(CorrespondenceError, match=message):
        camera_matches(**changes)
