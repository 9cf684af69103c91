"""Data of the tests of the matcher `structure`: the sample, altered."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

import calibgraph
from calibgraph import Camera, Dataset, Intrinsics, Rig, StructureMatcher
from calibgraph.matching.structure.schedule import Level


def without_search(levels: Sequence[Level]) -> StructureMatcher:
    """The matcher that begins at the guess."""
    return StructureMatcher(search_deg=0, search_m=0, levels=levels)


def far_from(truth: Rig, seed: int) -> Rig:
    return calibgraph.perturb(truth, rotation_deg=20, translation_m=1.5, seed=seed, uniform=True)


def never() -> bool:
    return False


def with_points_shuffled(data: Dataset, folder: Path, most: int | None = None) -> Dataset:
    """The dataset with the points of every cloud in another order, or so many of them."""
    rng = np.random.default_rng(0)
    frames = []
    for frame in data.frames:
        cloud = np.load(frame.cloud_path)
        path = folder / frame.cloud_path.name
        np.save(path, cloud[rng.permutation(len(cloud))[:most]])
        frames.append(replace(frame, cloud_path=path))
    return replace(data, frames=tuple(frames))


def with_noise_images(data: Dataset, name: str, folder: Path) -> Dataset:
    """The dataset with images of noise for one camera."""
    rng = np.random.default_rng(0)
    frames = []
    for frame in data.frames:
        path = folder / f"{frame.index}.png"
        cv2.imwrite(str(path), rng.integers(0, 255, (360, 640, 3), dtype=np.uint8))
        frames.append(replace(frame, image_paths={**frame.image_paths, name: path}))
    return replace(data, frames=tuple(frames))


def with_half_images(data: Dataset, name: str, truth: Camera, folder: Path) -> Dataset:
    """One camera of the dataset with images of half the size, at its true pose."""
    k = truth.intrinsics_px
    half = {
        "width_px": truth.width_px // 2,
        "height_px": truth.height_px // 2,
        "intrinsics_px": Intrinsics(
            fx=k.fx / 2, fy=k.fy / 2, cx=(k.cx + 0.5) / 2 - 0.5, cy=(k.cy + 0.5) / 2 - 0.5
        ),
    }
    small = Camera(**{**truth.model_dump(), **half})
    frames = []
    for frame in data.frames:
        image = cv2.imread(str(frame.image_paths[name]))
        path = folder / f"{frame.name}.png"
        size = (small.width_px, small.height_px)
        cv2.imwrite(str(path), cv2.resize(image, size, interpolation=cv2.INTER_AREA))
        frames.append(replace(frame, image_paths={name: path}))
    return Dataset(Rig(cameras={name: small}), tuple(frames), (folder,))
