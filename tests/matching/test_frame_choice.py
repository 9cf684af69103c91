"""Of a long recording the clear frames are matched, spread over it, and one where it stands."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import calibgraph
from calibgraph import Dataset, Frame, Rig, dataset_from_arrays
from calibgraph.matching.frame_choice import (
    CANDIDATES,
    View,
    choose_frames,
    find_stationary_frames,
    without_copies,
)
from tests.conftest import SAMPLE, make_camera


def parked(folder: Path, data: Dataset) -> Dataset:
    """The first frame of a dataset, and two more of it with other noise and a passing truck."""
    frames, rng = [], np.random.default_rng(0)
    for number in range(3):
        paths = {}
        for name, path in data.frames[0].image_paths.items():
            image = cv2.imread(str(path)).astype(np.float64)
            image += rng.normal(0, 3, image.shape)
            width = image.shape[1]
            image[:, number * width // 8 : number * width // 8 + width // 6] = 90
            paths[name] = folder / f"{name}_{number}.png"
            cv2.imwrite(str(paths[name]), np.clip(image, 0, 255).astype(np.uint8))
        frames.append(replace(data.frames[0], index=number, image_paths=paths))
    return replace(data, frames=tuple(frames))


def test_frames_of_a_parked_vehicle_are_of_one_place_also_after_a_drive(tmp_path: Path) -> None:
    data = calibgraph.load_dataset(SAMPLE)
    parking = parked(tmp_path, data)
    between = replace(data.frames[3], index=5)
    both = replace(data, frames=(parking.frames[0], between, *parking.frames[1:]))
    assert find_stationary_frames(both, data.rig) == [[0, 1, 2]]


def test_one_camera_that_moves_is_enough(tmp_path: Path) -> None:
    """As one whose images are all of one frame, in a vehicle that drives."""
    data = calibgraph.load_dataset(SAMPLE)
    first = next(iter(data.rig.cameras))
    frozen = data.frames[0].image_paths[first]
    frames = [replace(f, image_paths={**f.image_paths, first: frozen}) for f in data.frames]
    assert find_stationary_frames(replace(data, frames=tuple(frames)), data.rig) == []


def test_a_motion_of_half_a_pixel_is_a_motion() -> None:
    rng = np.random.default_rng(1)
    image = cv2.GaussianBlur(rng.uniform(0, 255, (480, 640)), (0, 0), 3)
    image = cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX)

    def shifted(pixels: float) -> View:
        moved = cv2.warpAffine(image, np.array([[1, 0, pixels], [0, 1, 0]]), (640, 480))
        return View.from_image(moved.astype(np.uint8))

    assert shifted(0.0).stands(shifted(0.3)) is True
    assert shifted(0.0).stands(shifted(0.8)) is False
    assert shifted(0.0).stands(shifted(5.0)) is False


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
