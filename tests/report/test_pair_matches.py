from __future__ import annotations

import base64

import cv2
import numpy as np
import pytest

from calibgraph import Calibration
from calibgraph.report.page_pairs import (
    draw_matches,
    pair_sections,
)


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


def test_every_pair_that_sees_something_in_common_has_a_section(sample_result: Calibration) -> None:
    (section,) = pair_sections(sample_result)
    assert section.name == "front_left, front_right"
    encoded = section.picture.removeprefix("data:image/jpeg;base64,")
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(encoded), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[1] > 1000
    assert 0.1 < section.surfaces / section.matches < 1
    assert float(section.median_px) < 1.5
    assert section.check is not None and section.check.status == "PASS"
