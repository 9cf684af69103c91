"""A training run: a network, its optimizer, and the number of steps done."""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from calibgraph.errors import CalibrationError, FileError
from calibgraph.files import write_atomically
from calibgraph.matching.cmrnext.checkpoint import TORCH_SUFFIXES, load_checkpoint, load_training
from calibgraph.matching.cmrnext.network import CmrNext, torch_device
from calibgraph.matching.cmrnext.training.losses import (
    correlation_loss,
    flow_at_points,
    flow_loss,
    optimum_loss,
    true_flow,
)
from calibgraph.matching.cmrnext.training.samples import Sample, Scene, stack_inputs
from calibgraph.matching.cmrnext.training.settings import (
    CONFIG_PREFIX,
    TrainSettings,
    adopt_architecture,
    settings_of,
)
from calibgraph.matching.cmrnext.training.validation import (
    Validation,
    pose_error,
    summarize_poses,
)
from calibgraph.outputs import Output, marked_yaml, require_writable

SETTINGS_SUFFIX = ".settings.yaml"
"""Of the file beside a checkpoint with the settings of its training."""

_WEIGHT_DECAY = 5e-6
_START, _END = 0.1, 1e-6  # of the one-cycle learning rate, as shares of its peak
_GRADIENT_NORM = 1.0
_MALFORMED = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)


class TrainingRun:
    """A network in training."""

    def __init__(self, settings: TrainSettings, device: str) -> None:
        self.settings, self.device, self.step = settings, torch_device(device), 0
        torch.manual_seed(settings.seed)
        self.network = CmrNext(settings.architecture)
        _initialize(self.network)
        self.network.to(self.device)
        self.optimizer = torch.optim.Adam(
            self.network.parameters(), lr=settings.learning_rate, weight_decay=_WEIGHT_DECAY
        )

    def learn(self, samples: list[Sample]) -> float:
        """Take one step; returns its loss."""
        s = self.settings
        for group in self.optimizer.param_groups:
            group["lr"] = s.learning_rate * one_cycle(self.step / s.steps, s.warm_up_share)
        loss = self._loss(samples)
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

    def _loss(self, samples: list[Sample]) -> Tensor:
        s = self.settings
        self.network.train()
        rgb, lidar = (t.to(self.device) for t in stack_inputs(samples, s.architecture))
        correlation = self.network.correlation(rgb, lidar)
        loss = torch.zeros((), device=self.device)
        if s.correlation_weight:
            loss = loss + s.correlation_weight * correlation_loss(
                correlation, samples, seed=self.step, halved=s.half_resolution
            )
        if self.step >= s.correlation_steps:
            flows = [*self.network.all_flows(correlation, rgb, lidar, iterations=s.iterations)]
            loss = loss + flow_loss(
                flows, samples, iterations=s.iterations, halved=s.half_resolution
            )
            if s.pose_weight:
                loss = loss + s.pose_weight * optimum_loss(flows[-1], samples, s)
        return loss

    @torch.inference_mode()
    def validate(self, samples: Sequence[tuple[Scene, Sample]], train_loss: float) -> Validation:
        """Errors of the flow on held-out samples, and of the poses estimated from it."""
        self.network.eval()
        errors, lengths, poses = [], [], []
        for scene, sample in samples:
            inputs = stack_inputs([sample], self.settings.architecture)
            rgb, lidar = (t.to(self.device) for t in inputs)
            flow = flow_at_points(
                self.network(rgb, lidar).flow_px, [sample], halved=self.settings.half_resolution
            )
            truth = true_flow([sample], self.device)
            errors.append((flow - truth).norm(dim=1))
            lengths.append(truth.norm(dim=1))
            poses.append(pose_error(scene, sample, flow.cpu().numpy()))
        error, length = torch.cat(errors), torch.cat(lengths)
        return Validation(
            step=self.step,
            train_loss=train_loss,
            epe_px=float(error.mean()),
            median_px=float(error.median()),
            zero_px=float(length.mean()),
            **summarize_poses(samples, poses, self.settings),
        )

    def save(self, out: Path, validation: Validation) -> None:
        """Write the checkpoint."""
        content = {
            "config": _to_config(self.settings, validation),
            "epoch": self.step,
            "state_dict": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "train_loss": validation.train_loss,
            "test_epe": validation.epe_px,
        }
        write_atomically(out, lambda temporary: torch.save(content, temporary))


def _to_config(settings: TrainSettings, validation: Validation) -> dict[str, Any]:
    """The checkpoint's config: the keys of the published files, and all settings."""
    return {
        "use_reflectance": settings.reflectance,
        "normalize_images": True,
        "max_depth": settings.max_depth_m,
        "upsample_method": "transposed",
        "fourier_levels": settings.architecture.fourier_levels,
        "context_encoder": settings.context,
        "uncertainty": False,
        "der_type": "NLL",
        "unc_freeze": False,
        "num_scales": 1,
        "al_contrario": False,
        "max_r": settings.rotation_deg,
        "max_t": settings.translation_m,
        **{f"{CONFIG_PREFIX}{key}": value for key, value in settings.model_dump().items()},
        "half_resolution": settings.half_resolution,
        "systematic_rotation_rad": validation.systematic_rotation_rad,
        "systematic_translation_m": validation.systematic_translation_m,
    }


def start_run(
    out: Path, settings: TrainSettings, device: str, start: Path | str | None
) -> TrainingRun:
    """Begin a training, from given weights or from nothing, and write its settings beside ``out``.

    Raises:
        FileError: if ``out`` exists, cannot be written or has a wrong suffix, or if the weights
            cannot be trained.
    """
    if out.exists():
        raise FileError(out, "is there already; go on with it (--resume), or choose another name")
    if out.suffix.lower() not in TORCH_SUFFIXES:
        raise FileError(out, f"the weights' name must end in one of {', '.join(TORCH_SUFFIXES)}")
    beside = out.with_suffix(SETTINGS_SUFFIX)
    require_writable([Output(out, "train"), marked_yaml(beside, "train")])
    if start is None:
        run = TrainingRun(settings, device)
    else:
        checkpoint = load_checkpoint(start)
        run = TrainingRun(adopt_architecture(settings, checkpoint), device)
        run.network.load_state_dict(checkpoint.state)
    run.settings.save(beside)
    return run


def resume_run(out: Path, device: str) -> TrainingRun:
    """Continue the training that wrote the checkpoint ``out``.

    Raises:
        FileError: if there is none, or it cannot be continued.
    """
    if not out.exists():
        raise FileError(out, "no such checkpoint to go on with; start without --resume")
    checkpoint, content = load_training(out)
    try:
        run = TrainingRun(settings_of(checkpoint.config), device)
        run.network.load_state_dict(checkpoint.state)
        run.optimizer.load_state_dict({
            "state": _adam_state(content["optimizer"], run.network.parameters()),
            "param_groups": run.optimizer.state_dict()["param_groups"],
        })  # fmt: skip
        run.step = int(content["epoch"])
        if not 0 <= run.step <= run.settings.steps:
            raise ValueError(f"{run.step} of {run.settings.steps} steps are done")
    except _MALFORMED as error:
        raise FileError(out, f"is no checkpoint that training can go on with: {error}") from None
    if run.step == run.settings.steps:
        raise FileError(out, f"has had all its {run.settings.steps} steps")
    return run


def _adam_state(
    content: Mapping[str, Any], parameters: Iterator[nn.Parameter]
) -> dict[int, dict[str, Tensor]]:
    """Adam's state of the parameters that have one, compared with their shapes."""
    state: dict[int, dict[str, Tensor]] = {}
    for number, parameter in enumerate(parameters):
        if number not in content["state"]:  # not trained so far
            continue
        given = content["state"][number]
        shapes = {"step": torch.Size(), "exp_avg": parameter.shape, "exp_avg_sq": parameter.shape}
        for key, shape in shapes.items():
            if given[key].shape != shape or not torch.isfinite(given[key]).all():
                raise ValueError(f"its optimizer's {key!r} is of another network or not finite")
        state[number] = {key: given[key].clone() for key in shapes}
    return state


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
