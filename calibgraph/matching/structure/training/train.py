"""Training of the windows' weights: the likelihood of trusted poses through the graph's optimum."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from calibgraph.arrays import Array
from calibgraph.errors import DatasetError
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.matching.structure.frame_cache import FrameCache
from calibgraph.matching.structure.training.loss import pose_negative_log_likelihood
from calibgraph.matching.structure.training.samples import CameraWindows, camera_windows
from calibgraph.matching.structure.training.settings import WindowSettings
from calibgraph.matching.structure.training.trainee import Trainee
from calibgraph.matching.structure.window_weights import MAX_HOW, WindowNetwork, window_network
from calibgraph.progress import Progress, no_progress

_LARGEST_GRADIENT = 10.0  # norm of a step's: a camera whose pose is lost has a far larger one


@dataclass(frozen=True, eq=False)
class WindowTraining:
    """A trained network, and what its training reached.

    Attributes:
        network: the trained one.
        loss: mean negative log-likelihood of a camera's trusted pose, before and after.
        held_out: the same of recordings that took no part; infinite without any.
        held_out_cameras: how many these have.
        standard_error: of the mean change of their loss; NaN of fewer than two.
    """

    network: WindowNetwork
    loss: tuple[float, float]
    held_out: tuple[float, float]
    held_out_cameras: int
    standard_error: float


def train_windows(
    datasets: Sequence[Dataset],
    held_out: Sequence[Dataset] = (),
    settings: WindowSettings | None = None,
    *,
    start: WindowNetwork | None = None,
    progress: Progress = no_progress,
) -> WindowTraining:
    """Train the weights of windows on the poses of rigs.

    Args:
        datasets: recordings with the trusted poses of their cameras, those of ``Dataset.rig``.
        held_out: recordings that only measure.
        settings: of the training.
        start: the network to begin with; None for the package's.
        progress: called as the work goes on.

    Raises:
        DatasetError: if no camera has enough matches.
    """
    settings, trainee = settings or WindowSettings(), Trainee(start or window_network())
    torch.manual_seed(settings.seed)
    samples = _samples(datasets, settings, progress)
    others = _samples(held_out, settings, progress)
    before = _losses(trainee, samples), _losses(trainee, others)
    if not np.isfinite(before[0]).any():
        raise DatasetError("no camera has enough windows with structure to learn from")
    _learn(trainee, samples, settings, progress)
    first, last = _matched(before[0], _losses(trainee, samples))
    other_first, other_last = _matched(before[1], _losses(trainee, others))
    return WindowTraining(
        trainee.to_network(_origin(datasets, len(samples), settings)),
        (_mean(first), _mean(last)),
        (_mean(other_first), _mean(other_last)),
        len(other_first),
        _standard_error(other_last - other_first),
    )


def _origin(datasets: Sequence[Dataset], cameras: int, settings: WindowSettings) -> str:
    """How the network was trained, as its file states it."""
    names = ", ".join(data.folders[0].name for data in datasets)
    how = f"calibgraph train-windows, seed {settings.seed}: {cameras} cameras of {names}"
    return "".join(filter(str.isprintable, how))[:MAX_HOW]


def _samples(
    datasets: Sequence[Dataset], settings: WindowSettings, progress: Progress
) -> list[CameraWindows]:
    """The windows of every camera of every recording."""
    found = []
    for number, data in enumerate(datasets):
        cache = FrameCache()
        for name, camera in data.rig.cameras.items():
            progress(f"windows of {name}", number, len(datasets))
            frames = [frame for frame in data.frames if name in frame.image_paths]
            chosen = spread_out(frames, settings.frames)
            found.append(
                camera_windows(chosen, name, camera, per_frame=settings.windows, cache=cache)
            )
    return [sample for sample in found if sample is not None]


def _learn(
    trainee: Trainee,
    samples: Sequence[CameraWindows],
    settings: WindowSettings,
    progress: Progress,
) -> None:
    """Minimize the loss by AdamW."""
    parameters, rate = trainee.layers.parameters(), settings.learning_rate
    optimizer = torch.optim.AdamW(parameters, rate / 2, weight_decay=settings.weight_decay)
    total = settings.epochs * -(-len(samples) // settings.batch)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, total_steps=total)
    for step, batch in enumerate(_batches(samples, settings)):
        progress("training", step, total)
        optimizer.zero_grad()
        for sample in batch:
            weights = trainee.weights(sample.features, settings.noise)
            loss = pose_negative_log_likelihood(weights, sample)
            if loss is not None:
                (loss / len(batch)).backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(trainee.layers.parameters(), _LARGEST_GRADIENT)
        optimizer.step()
        schedule.step()


def _batches(
    samples: Sequence[CameraWindows], settings: WindowSettings
) -> Iterator[list[CameraWindows]]:
    """All cameras once per epoch, shuffled."""
    for _ in range(settings.epochs):
        order = torch.randperm(len(samples)).tolist()
        for first in range(0, len(order), settings.batch):
            yield [samples[number] for number in order[first : first + settings.batch]]


@torch.no_grad()
def _losses(trainee: Trainee, samples: Sequence[CameraWindows]) -> Array:
    """(n,) per camera; infinite with too few matches."""
    losses = [
        pose_negative_log_likelihood(trainee.weights(sample.features), sample) for sample in samples
    ]
    return np.array([math.inf if loss is None else float(loss) for loss in losses])


def _matched(before: Array, after: Array) -> tuple[Array, Array]:
    """Those of the cameras that had matches; one that has lost them is infinitely worse."""
    had = np.isfinite(before)
    return before[had], after[had]


def _mean(losses: Array) -> float:
    """Infinite without any."""
    return float(losses.mean()) if len(losses) else math.inf


def _standard_error(changes: Array) -> float:
    """Of their mean; NaN of fewer than two, or if one is infinite."""
    if len(changes) < 2 or not np.isfinite(changes).all():  # noqa: PLR2004
        return math.nan
    return float(np.std(changes, ddof=1) / math.sqrt(len(changes)))
