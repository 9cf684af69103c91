"""Batches of training samples, drawn in the background."""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from calibgraph.errors import DatasetError
from calibgraph.matching.cmrnext.training.samples import Sample, make_sample
from calibgraph.matching.cmrnext.training.scenes import Scene
from calibgraph.matching.cmrnext.training.settings import TrainSettings

_TRIES = 20  # to draw a scene with enough points in the image


def draw_batches(
    scenes: Sequence[Scene], settings: TrainSettings, *, start: int
) -> Iterator[list[Sample]]:
    """Batches from step ``start`` on; the samples of a step depend on the seed alone.

    Raises:
        DatasetError: if no scene has enough points in the image.
    """
    with ThreadPoolExecutor(max_workers=1) as pool:
        coming = pool.submit(_draw_batch, scenes, settings, start)
        for step in range(start, settings.steps):
            samples = coming.result()
            if step + 1 < settings.steps:
                coming = pool.submit(_draw_batch, scenes, settings, step + 1)
            yield samples


def _draw_batch(scenes: Sequence[Scene], settings: TrainSettings, step: int) -> list[Sample]:
    rng = np.random.default_rng([settings.seed, step])
    return [_draw_sample(scenes, settings, rng) for _ in range(settings.batch)]


def _draw_sample(
    scenes: Sequence[Scene], settings: TrainSettings, rng: np.random.Generator
) -> Sample:
    for _ in range(_TRIES):
        scene = scenes[int(rng.integers(len(scenes)))]
        sample = make_sample(scene, settings, rng, augment=True)
        if sample is not None:
            return sample
    raise DatasetError(
        f"{_TRIES} draws from the frames showed no points in the image; check the rig's "
        "T_camera_lidar (p_camera = T_camera_lidar * p_lidar)"
    )
