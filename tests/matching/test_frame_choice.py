"""Of a long recording the clear frames are matched, spread over it, and one where it stands."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibgraph import Dataset, Frame, Rig, dataset_from_arrays
from calibgraph.matching.frame_choice import CANDIDATES, choose_frames, without_copies
from tests.conftest import make_camera

CLOUD = np.ones((5, 4), np.float32)
WIDTH, HEIGHT = 320, 200
RIG = Rig(
    cameras={
        name: make_camera().model_copy(update={"width_px": WIDTH, "height_px": HEIGHT})
        for name in ("front", "rear")
    }
)
WALL = cv2.resize(
    np.random.default_rng(0).integers(0, 255, (60, 2000), dtype=np.uint8), (20_000, HEIGHT * 3),
    interpolation=cv2.INTER_CUBIC,
)  # fmt: skip


def drive(
    at_px: list[int], spoilt: dict[int, str] | None = None, *, copies: bool = False
) -> Dataset:
    """Frames along a wall, of which the front camera's images of some are spoilt.

    Clouds differ, unless those of frames at one place are to be copies.
    """
    images: dict[str, list[np.ndarray]] = {"front": [], "rear": []}
    for number, place in enumerate(at_px):
        view = np.ascontiguousarray(WALL[:HEIGHT, place : place + WIDTH])
        images["rear"].append(
            np.ascontiguousarray(WALL[HEIGHT : 2 * HEIGHT, place : place + WIDTH])
        )
        how = (spoilt or {}).get(number, "")
        if how == "blurred":
            view = cv2.blur(view, (41, 1))
        elif how == "dark":
            view = view // 20
        images["front"].append(view)
    clouds = [CLOUD + (0 if copies else number) for number in range(len(at_px))]
    return dataset_from_arrays(RIG, clouds, images)


def chosen(data: Dataset, most: int) -> list[int]:
    return [frame.index for frame in choose_frames(data, RIG, most).dataset.frames]


@pytest.mark.parametrize("how", ["blurred", "dark"])
def test_the_clear_one_of_neighbours_is_chosen(how: str) -> None:
    clear = [1, 5, 6, 9]
    spoilt = {number: how for number in range(12) if number not in clear}
    assert chosen(drive([100 * k for k in range(12)], spoilt), 4) == clear


def test_frames_are_spread_over_the_recording() -> None:
    found = chosen(drive([50 * k for k in range(300)]), 10)
    thirds = np.linspace(0, 299, 10 * CANDIDATES).round()
    assert set(found) <= set(thirds)
    assert [number // 30 for number in found] == list(range(10))


def test_an_image_that_cannot_be_read_is_left_out() -> None:
    data = drive([100 * k for k in range(9)])
    frames = list(data.frames)
    gone = Frame(4, "gone", frames[4].cloud_path, {"front": Path("no.png"), "rear": Path("no.png")})
    frames[4] = gone
    choice = choose_frames(replace(data, frames=tuple(frames)), RIG, 3)
    assert 4 not in [frame.index for frame in choice.dataset.frames]
    assert choice.text.endswith("1 have an image that cannot be read")


def test_no_copy_takes_the_place_of_another_frame() -> None:
    """Of 12 frames, each three times, 12 are wanted."""
    data = drive([100 * (k // 3) for k in range(36)], copies=True)
    choice = choose_frames(data, RIG, 12)
    assert [frame.index for frame in choice.dataset.frames] == list(range(0, 36, 3))
    assert len(choice.copies) == 24


def test_copies_of_a_frame_are_left_out() -> None:
    """Those with the same cloud and images; not where one of them changes."""
    data = drive([0, 50, 0, 50, 0], copies=True)
    choice = without_copies(data)
    assert [frame.index for frame in choice.dataset.frames] == [0, 1]
    names = [frame.name for frame in data.frames]
    assert choice.copies == tuple((names[k], names[k % 2]) for k in (2, 3, 4))
    data = drive([0, 50])
    assert without_copies(data).dataset is data
    frozen = dataset_from_arrays(
        RIG, [CLOUD, CLOUD + 1], {n: [WALL[:HEIGHT, :WIDTH]] * 2 for n in RIG.cameras}
    )
    assert without_copies(frozen).dataset is frozen
