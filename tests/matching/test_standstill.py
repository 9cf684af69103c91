"""Frames of one place: by the motion of images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

import calibgraph
from calibgraph import Dataset
from calibgraph.matching.standstill import View, find_stationary_frames
from tests.conftest import SAMPLE


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
