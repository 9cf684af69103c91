"""Training from frames with a trusted extrinsic: perturb it, learn the flow that undoes it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from calibgraph.errors import CalibrationError, DatasetError, FileError
from calibgraph.files import require_place_for_file, write_atomically
from calibgraph.io.dataset import Dataset
from calibgraph.matching.cmrnext.checkpoint import TORCH_SUFFIXES, load_checkpoint
from calibgraph.matching.cmrnext.correlation import WINDOW, Correlation, cross_entropy
from calibgraph.matching.cmrnext.network import CELL, CmrNext, torch_device
from calibgraph.matching.cmrnext.pickle_reader import read_checkpoint
from calibgraph.matching.cmrnext.samples import (
    Sample,
    Scene,
    at_full_resolution,
    make_sample,
    network_inputs,
)
from calibgraph.matching.cmrnext.training.scenes import require_apart, scenes_of
from calibgraph.matching.cmrnext.training.settings import (
    TrainSettings,
    config_of,
    settings_from,
    settings_in,
)
from calibgraph.matching.cmrnext.training.validation import (
    Validation,
    pose_error,
    pose_figures,
    validation_samples,
)
from calibgraph.progress import Progress

Array = NDArray[np.float64]

_DISCOUNT = 0.8  # of each iteration's loss against the next one's
_WEIGHT_DECAY = 5e-6
_START, _END = 0.1, 1e-6  # of the one-cycle learning rate, as shares of its peak
_GRADIENT_NORM = 1.0
_OFFSET_CELLS = 3.5  # of the correlation loss's windows from the truth, at most
_FOREIGN = (
    ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError,
)  # fmt: skip # what torch raises on the state of another optimizer
_TRIES = 20  # to draw a sample that shows enough points


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
    """Train a network and write its checkpoint.

    Args:
        datasets: frames of rigs with trusted extrinsics.
        held_out: frames to validate on; none of them may be in ``datasets``.
        out: the checkpoint, written at every validation and at the end.
        settings: what to train; with ``resume``, those of the file, and this must be None.
        device: ``cpu``, ``cuda``, or ``auto``.
        validate_every: steps.
        start: weights to begin with (fine-tuning); the network and what it is shown are theirs.
        resume: go on where the checkpoint ``out`` stopped.
        report: told every validation.
        progress: told of every step.

    Returns:
        The validations of this run.

    Raises:
        FileError: if ``start`` cannot be trained, or ``out`` is there and ``resume`` is not asked
            for, or the reverse.
        DatasetError: if the two sets share frames, or no frame shows enough points.
    """
    out = Path(out)
    scenes, others = scenes_of(datasets), scenes_of(held_out)
    require_apart(scenes, others)
    if resume:
        run = _resumed(out, device)
    else:
        run = _fresh(out, settings or TrainSettings(), device, start)
    checks = validation_samples(
        others,
        run.settings.samples(augment=False),
        run.settings.variant,
        seed=run.settings.seed,
    )
    validations: list[Validation] = []
    losses: list[float] = []
    for samples in _batches(scenes, run.settings, start=run.step):
        losses.append(run.learn(samples))
        if progress is not None:
            progress("training", run.step, run.settings.steps)
        if run.step % validate_every == 0 or run.step == run.settings.steps:
            validations.append(run.validate(checks, float(np.mean(losses))))
            losses.clear()
            run.save(out, validations[-1])
            if report is not None:
                report(validations[-1])
    return validations


class _Run:
    """A network in training, its optimizer, and how far it is."""

    def __init__(self, settings: TrainSettings, device: str) -> None:
        self.settings, self.device, self.step = settings, torch_device(device), 0
        torch.manual_seed(settings.seed)
        self.network = CmrNext(settings.variant)
        _initialize(self.network)
        self.network.to(self.device)
        self.optimizer = torch.optim.Adam(
            self.network.parameters(), lr=settings.learning_rate, weight_decay=_WEIGHT_DECAY
        )

    def learn(self, samples: list[Sample]) -> float:
        """One step; returns its loss."""
        s = self.settings
        for group in self.optimizer.param_groups:
            group["lr"] = s.learning_rate * one_cycle(self.step / s.steps, s.warm_up_share)
        self.network.train()
        rgb, lidar = (t.to(self.device) for t in network_inputs(samples, s.variant))
        correlation = self.network.correlation(rgb, lidar)
        loss = torch.zeros((), device=self.device)
        if s.correlation_weight:
            loss = loss + s.correlation_weight * self._correlation_loss(correlation, samples)
        if self.step >= s.correlation_steps:
            loss = loss + self._flow_loss(correlation, rgb, lidar, samples)
        if not torch.isfinite(loss):
            raise CalibrationError(
                f"training diverged at step {self.step}: the loss is {float(loss.detach())}; lower "
                "the learning rate; the weights written last are as they were"
            )
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.network.parameters(), _GRADIENT_NORM)
        self.optimizer.step()
        self.step += 1
        return float(loss.detach())

    def require_sound(self) -> None:
        """Check the optimizer's state against the network.

        Raises:
            ValueError: if it is of another network, or not finite.
        """
        if not 0 <= self.step <= self.settings.steps:
            raise ValueError(f"it says {self.step} of {self.settings.steps} steps")
        for parameter, state in self.optimizer.state.items():
            for key in ("exp_avg", "exp_avg_sq"):
                if state[key].shape != parameter.shape or not torch.isfinite(state[key]).all():
                    raise ValueError(f"its optimizer's {key!r} is of another network or not finite")

    @torch.inference_mode()
    def validate(self, samples: list[tuple[Scene, Sample]], train_loss: float) -> Validation:
        """The flow's errors on held-out samples, and those of the poses that it leads to."""
        self.network.eval()
        errors, lengths, poses = [], [], []
        for scene, sample in samples:
            inputs = network_inputs([sample], self.settings.variant)
            rgb, lidar = (t.to(self.device) for t in inputs)
            found = self._at_points(self.network(rgb, lidar).flow_px, [sample])
            truth = self._truth([sample])
            errors.append((found - truth).norm(dim=1))
            lengths.append(truth.norm(dim=1))
            poses.append(pose_error(scene, sample, found.cpu().numpy()))
        error, length = torch.cat(errors), torch.cat(lengths)
        return Validation(
            step=self.step,
            train_loss=train_loss,
            epe_px=float(error.mean()),
            median_px=float(error.median()),
            zero_px=float(length.mean()),
            **pose_figures(samples, poses, self.settings.samples(augment=False)),
        )

    def save(self, out: Path, validation: Validation) -> None:
        """Write the checkpoint."""
        content = {
            "config": config_of(self.settings, validation),
            "epoch": self.step,
            "state_dict": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "train_loss": validation.train_loss,
            "test_epe": validation.epe_px,
        }
        write_atomically(out, lambda temporary: torch.save(content, temporary))

    def _flow_loss(
        self, correlation: Correlation, rgb: Tensor, lidar: Tensor, samples: list[Sample]
    ) -> Tensor:
        """The published loss: every iteration's error at the points, over all pixels."""
        iterations, truth = self.settings.iterations, self._truth(samples)
        pixels = sum(sample.size[0] * sample.size[1] for sample in samples)
        loss = torch.zeros((), device=self.device)
        flows = self.network.all_flows(correlation, rgb, lidar, iterations=iterations)
        for iteration, flow in enumerate(flows, start=1):
            error = (self._at_points(flow, samples) - truth).abs().sum()
            loss = loss + _DISCOUNT ** (iterations - iteration) * error / (2 * pixels)
        return loss

    def _correlation_loss(self, correlation: Correlation, samples: list[Sample]) -> Tensor:
        """Cross-entropy of each LiDAR cell's window about, but not at, where its points truly are.

        The windows' centres are drawn at random around the truth, so that every target is in one.
        """
        cell = CELL * (1 + self.settings.half_resolution)
        height, width = (size // CELL for size in samples[0].rgb.shape[1:])
        count = torch.zeros(len(samples) * height * width, 1)
        total = torch.zeros(len(samples) * height * width, 2)
        for i, sample in enumerate(samples):
            y, x = (sample.cells // cell).T
            index = (i * height + y) * width + x
            count.index_add_(0, index, torch.ones(len(index), 1))
            total.index_add_(0, index, torch.stack([x, y], dim=1) + sample.flow_px / cell)
        known = count[:, 0].nonzero()[:, 0]
        truth = total / count.clamp(min=1.0)
        generator = torch.Generator().manual_seed(self.step)
        offsets = _OFFSET_CELLS * (2 * torch.rand(len(truth), 2, generator=generator) - 1)
        centres = (truth + offsets).view(len(samples), height, width, 2).permute(0, 3, 1, 2)
        windows = correlation.window(centres.to(self.device))[:, : WINDOW**2]
        rows = windows.permute(0, 2, 3, 1).reshape(-1, WINDOW**2)
        return cross_entropy(rows[known.to(self.device)], -offsets[known].to(self.device))

    def _at_points(self, flow: Tensor, samples: list[Sample]) -> Tensor:
        """(n, 2) flow at the points of all samples."""
        full = at_full_resolution(flow, halved=self.settings.half_resolution)
        cells = [sample.cells.to(self.device) for sample in samples]
        return torch.cat([full[i, :, c[:, 0], c[:, 1]].T for i, c in enumerate(cells)])

    def _truth(self, samples: list[Sample]) -> Tensor:
        return torch.cat([sample.flow_px for sample in samples]).to(self.device)


def one_cycle(share: float, warm_up: float) -> float:
    """Learning rate as a share of its peak, after a share of the steps (cosine up, then down)."""
    if share < warm_up:
        low, phase = _START, share / warm_up
    else:
        low, phase = _END, 1 - (share - warm_up) / (1 - warm_up)
    return low + (1 - low) * (1 - math.cos(math.pi * phase)) / 2


def _initialize(network: nn.Module) -> None:
    """He initialisation of the encoders, as RAFT."""
    for encoder in (network.fnet_img, network.fnet_lidar, network.cnet):
        assert isinstance(encoder, nn.Module)
        for module in encoder.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")


def _fresh(out: Path, settings: TrainSettings, device: str, start: Path | str | None) -> _Run:
    if out.exists():
        raise FileError(out, "is there already; go on with it (--resume), or choose another name")
    if out.suffix.lower() not in TORCH_SUFFIXES:
        raise FileError(out, f"the weights' name must end in one of {', '.join(TORCH_SUFFIXES)}")
    require_place_for_file(out)
    if start is None:
        return _Run(settings, device)
    checkpoint = load_checkpoint(start)
    run = _Run(settings_from(settings, checkpoint), device)
    run.network.load_state_dict(checkpoint.state)
    return run


def _resumed(out: Path, device: str) -> _Run:
    if not out.exists():
        raise FileError(out, "no such checkpoint to go on with; start without --resume")
    checkpoint = load_checkpoint(out)
    content = read_checkpoint(out)
    try:
        settings = settings_in(checkpoint.config)
        run = _Run(settings, device)
        run.network.load_state_dict(checkpoint.state)
        run.optimizer.load_state_dict(_optimizer_state(content["optimizer"]))
        run.step = int(content["epoch"])
        run.require_sound()
    except (
        ArithmeticError,
        AttributeError,
        LookupError,
        RuntimeError,
        TypeError,
        ValueError,
    ) as error:
        raise FileError(out, f"is no checkpoint that training can go on with: {error}") from None
    if run.step >= settings.steps:
        raise FileError(out, f"has had all its {settings.steps} steps")
    return run


def _optimizer_state(content: Mapping[str, Any]) -> dict[str, Any]:
    """Adam's state as torch takes it, from a checkpoint's plain data."""
    state = {
        number: {
            key: torch.from_numpy(np.array(value)) if isinstance(value, np.ndarray) else value
            for key, value in each.items()
        }
        for number, each in content["state"].items()
    }
    return {"state": state, "param_groups": content["param_groups"]}


def _batches(
    scenes: Sequence[Scene], settings: TrainSettings, *, start: int
) -> Iterator[list[Sample]]:
    """Batches from step ``start`` on; which samples a step has depends on the seed alone."""
    with ThreadPoolExecutor(max_workers=1) as pool:
        coming = pool.submit(_batch, scenes, settings, start)
        for step in range(start, settings.steps):
            samples = coming.result()
            if step + 1 < settings.steps:
                coming = pool.submit(_batch, scenes, settings, step + 1)
            yield samples


def _batch(scenes: Sequence[Scene], settings: TrainSettings, step: int) -> list[Sample]:
    rng = np.random.default_rng([settings.seed, step])
    return [_drawn(scenes, settings, rng) for _ in range(settings.batch)]


def _drawn(scenes: Sequence[Scene], settings: TrainSettings, rng: np.random.Generator) -> Sample:
    how = settings.samples(augment=True)
    for _ in range(_TRIES):
        scene = scenes[int(rng.integers(len(scenes)))]
        sample = make_sample(scene, settings=how, variant=settings.variant, rng=rng)
        if sample is not None:
            return sample
    raise DatasetError(
        f"{_TRIES} draws from the frames showed no points in the image; check the rig's "
        "T_camera_lidar (p_camera = T_camera_lidar * p_lidar)"
    )
