"""Training from frames with trusted extrinsics: perturb one, learn the flow that undoes it."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from calibgraph.io.dataset import Dataset
from calibgraph.matching.cmrnext.training.batches import draw_batches
from calibgraph.matching.cmrnext.training.run import resume_run, start_run
from calibgraph.matching.cmrnext.training.scenes import list_scenes, require_disjoint
from calibgraph.matching.cmrnext.training.settings import TrainSettings
from calibgraph.matching.cmrnext.training.validation import Validation, make_validation_samples
from calibgraph.progress import Progress


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
    scenes, others = list_scenes(datasets), list_scenes(held_out)
    require_disjoint(scenes, others)
    if resume:
        run = resume_run(out, device)
    else:
        run = start_run(out, settings or TrainSettings(), device, start)
    unseen = make_validation_samples(others, run.settings)
    validations: list[Validation] = []
    losses: list[float] = []
    for samples in draw_batches(scenes, run.settings, start=run.step):
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
