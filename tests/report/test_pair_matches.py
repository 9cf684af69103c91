from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

import calibgraph
from calibgraph.matching.camera_pairs import match_cameras, with_surfaces
from calibgraph.report.pair_matches import (
    RESIDUAL_LIMIT_PX,
    draw_matches,
    residual_colours,
    write_pair_pictures,
)
from calibgraph.solver.camera_pairs import match_errors_px
from tests.conftest import SAMPLE


def test_colours_go_from_green_to_red_and_grey_is_unknown() -> None:
    colours = residual_colours(np.array([0, RESIDUAL_LIMIT_PX, np.inf, np.nan]))
    assert colours.tolist() == [[0, 220, 0], [0, 0, 255], [0, 0, 255], [160, 160, 160]]


@pytest.mark.parametrize(("size", "beside"), [((100, 120), True), ((100, 400), False)])
def test_a_line_joins_the_feature_in_both_images(size: tuple[int, int], beside: bool) -> None:
    images = (np.zeros((*size, 3), np.uint8),) * 2
    pixels = np.array([[[50.0, 20.0], [60.0, 70.0]]])
    drawn = draw_matches(images, pixels, np.array([0.0]))
    other = (60 + size[1], 70) if beside else (60, 70 + size[0])
    for column, row in ((50, 20), other):
        assert drawn[row, column].tolist() == [0, 220, 0]
    middle = (np.array([50, 20]) + other) // 2
    near = drawn[middle[1] - 1 : middle[1] + 2, middle[0] - 1 : middle[0] + 2]
    assert near[..., 1].max() > 100


def test_many_matches_and_none_can_be_drawn() -> None:
    images = (np.zeros((50, 60, 3), np.uint8), np.zeros((40, 80, 3), np.uint8))
    rng = np.random.default_rng(0)
    full = draw_matches(images, rng.uniform(0, 40, (1000, 2, 2)), rng.uniform(0, 5, 1000))
    none = draw_matches(images, np.empty((0, 2, 2)), np.empty(0))
    assert full.shape == none.shape == (74, 140, 3)
    assert not none[:50].any()


def test_every_pair_of_a_frame_gets_a_picture(tmp_path: Path) -> None:
    data = calibgraph.load_dataset(SAMPLE).select("0:2")
    truth = calibgraph.load_rig(SAMPLE / "reference.yaml")
    matches = with_surfaces(match_cameras(data, truth), data, truth)
    errors = match_errors_px(truth, matches)
    paths = write_pair_pictures(data.frames[1], truth, matches, errors, tmp_path)
    assert [path.name for path in paths] == ["pair_front_left_front_right.png"]
    assert cv2.imread(str(paths[0])).shape[1] > 1000
    known = np.isfinite(errors)
    assert 0.2 < known.mean() < 1
    assert np.median(errors[known]) < 1.5
