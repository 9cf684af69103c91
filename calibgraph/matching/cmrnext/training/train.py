"""Training from frames with trusted extrinsics: perturb one, learn the flow that undoes it."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from calibgraph.errors import DatasetError
from calibgraph.io.dataset import Dataset
from calibgraph.matching.cmrnext.training.run import resume_run, start_run
from calibgraph.matching.cmrnext.training.samples import Sample, Scene, make_sample
from calibgraph.matching.cmrnext.training.settings import TrainSettings
from calibgraph.matching.cmrnext.training.validation import Validation, make_validation_samples
from calibgraph.progress import Progress

_TRIES = 20  # to draw a scene with enough points in the image


def train(
    datasets: Sequence[Dataset],
    held_out: Sequence[Dataset],
    out: Path | str,
    settings: TrainSettings | None = None,
    *,
    device: str = "auto",
    validate_every: int = 500,
    start: Path | str | None = None,
    resume: bool = False,
    report: Callable[[Validation], None] | None = None,
    progress: Progress | None = None,
) -> list[Validation]:
    """Train a network and write its checkpoint, and its settings beside it.

    Args:
        datasets: frames of rigs with trusted extrinsics.
        held_out: frames to validate on; none of them may be in ``datasets``.
        out: the checkpoint, written at every validation and at the end.
        settings: of the training; with ``resume``, those of the file, and this must be None.
        device: ``cpu``, ``cuda``, or ``auto``.
        validate_every: steps between validations.
        start: weights to begin with (fine-tuning); they determine the network and its inputs.
        resume: continue the training that wrote the checkpoint ``out``.
        report: called with every validation.
        progress: called at every step.

    Returns:
        The validations of this run.

    Raises:
        FileError: if ``start`` cannot be trained, if ``out`` exists without ``resume``, or if it
            does not exist or cannot be continued with it.
        DatasetError: if the two sets share frames, or no frame has enough points in the image.
    """
    out = Path(out)
    scenes, others = _list_scenes(datasets), _list_scenes(held_out)
    _require_disjoint(scenes, others)
    if resume:
        run = resume_run(out, device)
    else:
        run = start_run(out, settings or TrainSettings(), device, start)
    unseen = make_validation_samples(others, run.settings)
    validations: list[Validation] = []
    losses: list[float] = []
    for samples in _draw_batches(scenes, run.settings, start=run.step):
        losses.append(run.learn(samples))
        if progress is not None:
            progress("training", run.step, run.settings.steps)
        if run.step % validate_every == 0 or run.step == run.settings.steps:
            validations.append(run.validate(unseen, float(np.mean(losses))))
            losses.clear()
            run.save(out, validations[-1])
            if report is not None:
                report(validations[-1])
    return validations


def _list_scenes(datasets: Sequence[Dataset]) -> list[Scene]:
    """Every camera of every frame."""
    return [
        Scene(frame, name, camera)
        for dataset in datasets
        for frame in dataset.frames
        for name, camera in dataset.rig.cameras.items()
    ]


def _require_disjoint(scenes: Sequence[Scene], held_out: Sequence[Scene]) -> None:
    """Check that no frame is both trained on and held out.

    Raises:
        DatasetError: naming one that is.
    """
    one, two = ({s.frame.cloud_path.resolve() for s in some} for some in (scenes, held_out))
    if both := one & two:
        raise DatasetError(
            f"{min(both)} is among the frames to train on and among those held out; hold out others"
        )


def _draw_batches(
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
