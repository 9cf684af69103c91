"""Mountings in words: what they mean, how sure they are, what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from calibgraph import RigError
from calibgraph.guessing.mounting import (
    HEADINGS,
    SAID_DEG,
    WORD_SIGMAS,
    Mounting,
    check_forward,
    parse_mounting,
)
from calibgraph.model.geometry import camera_center


def axis(mounting: Mounting, forward: str = "+x") -> np.ndarray:
    """(3,) where the camera looks, in the LiDAR frame."""
    return mounting.T_camera_lidar(check_forward(forward))[2, :3]


@pytest.mark.parametrize(
    ("words", "looks"),
    [
        ("front", (1, 0, 0)),
        ("left", (0, 1, 0)),
        ("rear", (-1, 0, 0)),
        ("back", (-1, 0, 0)),
        ("right", (0, -1, 0)),
        ("front-right", (np.sqrt(0.5), -np.sqrt(0.5), 0)),
        ("rear-left 45 deg right", (0, 1, 0)),
        ("front, 90 deg left", (0, 1, 0)),
        ("front, 90 deg down", (0, 0, -1)),
        ("front 30° up", (np.sqrt(0.75), 0, 0.5)),
        ("rear, 30 deg down", (-np.sqrt(0.75), 0, -0.5)),
    ],
)
def test_a_camera_looks_where_the_words_say(words: str, looks: tuple[float, ...]) -> None:
    np.testing.assert_allclose(axis(parse_mounting(words, "a")), looks, atol=1e-12)


@pytest.mark.parametrize(
    ("forward", "ahead", "left"),
    [("+x", "x", "y"), ("+y", "y", "-x"), ("-x", "-x", "-y"), ("-y", "-y", "x")],
)
def test_ahead_is_where_the_lidar_has_it(forward: str, ahead: str, left: str) -> None:
    unit = {"x": [1, 0, 0], "y": [0, 1, 0], "-x": [-1, 0, 0], "-y": [0, -1, 0]}
    np.testing.assert_allclose(axis(parse_mounting("front", "a"), forward), unit[ahead], atol=1e-12)
    T = parse_mounting("front, 2 m left", "a").T_camera_lidar(check_forward(forward))
    np.testing.assert_allclose(camera_center(T), 2 * np.array(unit[left]), atol=1e-12)


def test_a_camera_upside_down_sees_the_sky_below() -> None:
    T = parse_mounting("front, upside down", "a").T_camera_lidar()
    np.testing.assert_allclose(T[1, :3], (0, 0, 1), atol=1e-12)  # image down is up
    turned = parse_mounting("front, 90 deg clockwise", "a").T_camera_lidar()
    # Seen from behind, the top of the camera points right: image up is the vehicle's right.
    np.testing.assert_allclose(turned[1, :3], (0, 1, 0), atol=1e-12)
    np.testing.assert_allclose(
        axis(parse_mounting("front, upside down", "a")), (1, 0, 0), atol=1e-12
    )


def test_what_is_said_is_surer_than_what_is_left_open() -> None:
    open_ = parse_mounting("front", "a")
    assert dict(open_.sigmas) == WORD_SIGMAS
    said = parse_mounting("front 10 deg right, 2 m ahead, 0 m left, 1 m above", "a")
    assert said.sigmas["heading"] == SAID_DEG < WORD_SIGMAS["heading"]
    assert said.sigmas["tilt"] == WORD_SIGMAS["tilt"]
    assert said.sigmas["ahead"] == pytest.approx(np.hypot(0.05, 0.2))
    assert said.translation_sigma_m == said.sigmas["ahead"]
    assert said.rotation_sigma_deg == SAID_DEG


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("", "has no direction"),
        ("20 deg left", "has no direction"),
        ("sideways", "'sideways', which is not understood"),
        ("front rear", "gives the direction twice"),
        ("front, 10 deg left, 5 deg right", "gives the heading twice"),
        ("front, upside", "'upside'"),
        ("front, -20 deg down", "'-'"),
        ("front, 20 down", "'20 down'"),
        ("front, 20 deg", "'20 deg'"),
        ("front, 20 deg ahead", "'20 deg ahead'"),
        ("front, 3 ft ahead", "'3 ft ahead'"),
        ("front, 1 m ahead of the car", "'of'"),
        ("front, about 1 m ahead", "'about'"),
        ("front, 1e3 m ahead", "'1 e 3'"),
    ],
)
def test_what_is_not_understood_is_refused_with_what_is(words: str, said: str) -> None:
    with pytest.raises(RigError) as caught:
        parse_mounting(words, "cam")
    text = str(caught.value)
    assert said in text
    assert text.startswith("camera 'cam': ") and "\n" not in text
    assert all(heading in text for heading in HEADINGS)
