"""Lenses of others: camera matrices, names of models, lists of coefficients."""

from __future__ import annotations

from typing import Any

import pytest

from calibgraph.errors import FileError
from calibgraph.io.lenses import intrinsics_of_matrix


@pytest.mark.parametrize(
    ("K", "said"),
    [
        ([[480, 9, 320], [0, 480, 180], [0, 0, 1]], "its skew is 9 px"),
        ([[480, -0.2, 320], [0, 480, 180], [0, 0, 1]], "its skew is -0.2 px"),
        ([[960, 0, 640], [0, 960, 360], [0, 0, 2]], "undo its scale: divide by 2"),
        ([[480, 0, 0], [0, 480, 0], [320, 180, 1]], "write its rows first"),
        ([[480, 0, 0], [0, 1, 0], [0, 7e-310, 2.5e-323]], "write the camera matrix"),
        ([[0, 480, 320], [480, 0, 180], [0, 0, 1]], "holds no focal length"),
        ([[0] * 3] * 3, "holds no focal length"),
        ([[-480, 0, 320], [0, 480, 180], [0, 0, 1]], "holds no focal length"),
        ([[480, 0, float("nan")], [0, 480, 180], [0, 0, 1]], "holds no focal length"),
        ([[480, 0, 320, 0], [0, 480, 180, 0], [0, 0, 1, 0]], "has the shape (3, 4)"),
    ],
)
def test_what_is_no_camera_matrix_is_refused(K: Any, said: str) -> None:
    with pytest.raises(FileError) as caught:
        intrinsics_of_matrix(K, "lens.yaml: K")
    assert said in str(caught.value)
    assert str(caught.value).startswith("lens.yaml: K")


def test_a_skew_that_moves_no_point_by_a_tenth_of_a_pixel_is_rounded() -> None:
    found = intrinsics_of_matrix([[480, 0.04, 320], [0, 481, 180], [0, 0, 1]], "K")
    assert tuple(found.model_dump().values()) == (480, 481, 320, 180)
