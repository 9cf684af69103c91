"""Which frames are of which place, in a result and in words."""

from __future__ import annotations

import numpy as np

from calibgraph.model.places import NOWHERE, Places, describe_places


def test_a_result_names_the_frames_that_it_has() -> None:
    """Frames that no group names are of one further place."""
    places = Places(places=((0, 4), (1, 2, 9)))
    assert places.of_frames(np.array([4, 0, 0, 2, 7, 8])) == ((0, 4), (2,), (7, 8))
    assert NOWHERE.of_frames(np.array([1, 2])) == ()


def test_a_line_tells_how_many_places_and_which_frames() -> None:
    assert describe_places(((0, 1, 2, 7), (3, 5, 6))) == "2 places: frames 0-2, 7; 3, 5-6"
    assert describe_places(((4,),)) == "1 place: frames 4"
    many = describe_places(tuple((number,) for number in range(11)))
    assert many == "11 places: frames 0; 1; 2; 3; 4; 5; 6; 7; and 3 more"
