from __future__ import annotations

import base64
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibgraph import Calibration
from calibgraph.report.page_pairs import (
    RESIDUAL_LIMIT_PX,
    draw_matches,
    pair_sections,
    residual_colours,
)
from tests.report.conftest import write_page


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
    assert full.shape == none.shape == (50, 140, 3)
    assert not none[:50].any()


def test_every_pair_that_sees_something_in_common_has_a_section(sample_result: Calibration) -> None:
    (section,) = pair_sections(sample_result)
    assert section.name == "front_left, front_right"
    encoded = section.picture.removeprefix("data:image/jpeg;base64,")
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(encoded), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[1] > 1000
    assert 0.1 < section.surfaces / section.matches < 1
    assert float(section.median_px) < 1.5
    assert section.check is not None and section.check.status == "PASS"


def test_without_images_the_numbers_remain(sample_result: Calibration, tmp_path: Path) -> None:
    gone = tuple(
        {**entry, "images": {name: str(tmp_path / "gone.png") for name in entry["images"]}}
        for entry in sample_result.frames
    )
    (section,) = pair_sections(replace(sample_result, frames=gone))
    assert section.picture == "" and section.matches > 100
    assert pair_sections(replace(sample_result, camera_matches=None)) == []


def test_the_page_shows_the_pairs(sample_result: Calibration, tmp_path: Path) -> None:
    plain = replace(sample_result, correspondences=None)
    text = write_page(plain, tmp_path)
    assert "Between cameras" in text
    assert 'alt="Features that front_left, front_right both see"' in text
    bare = replace(plain, camera_matches=None)
    assert "Between cameras" not in write_page(bare, tmp_path)
