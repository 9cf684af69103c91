"""Training from frames with a trusted extrinsic: perturb it, learn the flow that undoes it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from calibgraph import kitti
from calibgraph.cmrnext.checkpoint import load_checkpoint, training_state
from calibgraph.cmrnext.correlation import WINDOW, Correlation, cross_entropy
from calibgraph.cmrnext.network import CELL, CmrNext, torch_device
from calibgraph.cmrnext.samples import (
    Sample,
    SampleSettings,
    Scene,
    at_full_resolution,
    make_sample,
    network_inputs,
)
from calibgraph.cmrnext.variant import Variant
from calibgraph.config import Config
from calibgraph.correspondences import Correspondences
from calibgraph.dataset import Dataset, load_dataset
from calibgraph.errors import DatasetError, FileError
from calibgraph.files import write_atomically
from calibgraph.load import load_rig
from calibgraph.rig import Rig
from calibgraph.stage1 import frame_pose

Array = NDArray[np.float64]
Report = Callable[[str, int, int], None]

REFERENCE_NAME = "reference.yaml"

_DISCOUNT = 0.8  # of each iteration's loss against the next one's
_WEIGHT_DECAY = 5e-6
_START, _END = 0.1, 1e-6  # of the one-cycle learning rate, as shares of its peak
_GRADIENT_NORM = 1.0
_VALIDATION_DRAWS = 1  # perturbations per held-out frame and camera
_OFFSET_CELLS = 3.5  # of the correlation loss's windows from the truth, at most
_PNP_MATCHES = 4000
_TRIES = 20  # to draw a sample that shows enough points


@dataclass(frozen=True)
class TrainSettings:
    """What to train, and on what. Everything is written into the checkpoint.

    Attributes:
        rotation_deg, translation_m: largest perturbation per axis, uniform: the network's range.
        steps: optimizer steps in all.
        batch: samples per step.
        iterations: of the recurrent update, in training.
        learning_rate: the peak of the one-cycle schedule.
        warm_up_share: of the steps, until that peak.
        correlation_weight: of an additional loss that pulls the two encoders' features together:
            cross-entropy of the correlation at the true cell. The published training has none; it
            saves short trainings the time until the flow's own loss reaches the encoders.
        correlation_steps: how many steps, at first, train the encoders by that loss alone.
        crop_px: height and width of random crops at full resolution; None: whole images.
        half_resolution: whether the network sees images of half their size.
        width, fourier_levels, reflectance, context: of the network, see :class:`Variant`.
        max_depth_m: what depths are divided by.
        seed: of the weights and of all samples.
    """

    rotation_deg: float = 20.0
    translation_m: float = 1.5
    steps: int = 100_000
    batch: int = 4
    iterations: int = 12
    learning_rate: float = 3e-4
    warm_up_share: float = 0.4
    correlation_weight: float = 0.0
    correlation_steps: int = 0
    crop_px: tuple[int, int] | None = (320, 960)
    half_resolution: bool = False
    width: int = 64
    fourier_levels: int = 12
    reflectance: bool = False
    context: Literal["lidar", "rgb"] = "lidar"
    max_depth_m: float = 160.0
    seed: int = 0

    @property
    def variant(self) -> Variant:
        """Of the network."""
        return Variant(
            fourier_levels=self.fourier_levels,
            reflectance=self.reflectance,
            context=self.context,
            width=self.width,
        )

    def samples(self, *, augment: bool) -> SampleSettings:
        """How samples are made: for training, or whole images for validation."""
        return SampleSettings(
            rotation_deg=self.rotation_deg,
            translation_m=self.translation_m,
            max_depth_m=self.max_depth_m,
            half_resolution=self.half_resolution,
            crop_px=self.crop_px if augment else None,
            augment=augment,
        )


@dataclass(frozen=True)
class Validation:
    """How a network does on frames that it was not trained on.

    Attributes:
        step: of the training.
        train_loss: mean since the last validation.
        epe_px: mean length of the flow's error, full-resolution pixels.
        median_px: its median.
        zero_px: mean length of the flow itself: the error of a network that finds nothing.
        pose_deg, pose_cm: median error of a single frame's pose, by PnP.
        start_deg, start_cm: that of the perturbed start.
        failed_share: of the frames, those without a pose.
        systematic_rotation_rad, systematic_translation_m: error per axis that the frames of a
            camera share; the matcher adds it to the error bar.
    """

    step: int
    train_loss: float
    epe_px: float
    median_px: float
    zero_px: float
    pose_deg: float
    pose_cm: float
    start_deg: float
    start_cm: float
    failed_share: float
    systematic_rotation_rad: float
    systematic_translation_m: float


def train(
    datasets: Sequence[Dataset],
    held_out: Sequence[Dataset],
    out: Path | str,
    settings: TrainSettings | None = None,
    *,
    device: str = "auto",
    validate_every: int = 500,
    resume: bool = False,
    report: Callable[[Validation], None] | None = None,
    progress: Report | None = None,
) -> list[Validation]:
    """Train a network and write its checkpoint.

    Args:
        datasets: frames of rigs with trusted extrinsics.
        held_out: frames to validate on; none of them may be in ``datasets``.
        out: the checkpoint, written at every validation and at the end.
        settings: what to train; with ``resume``, those of the file, and this must be None.
        device: ``cpu``, ``cuda``, or ``auto``.
        validate_every: steps.
        resume: go on where the checkpoint ``out`` stopped.
        report: told every validation.
        progress: told of every step.

    Returns:
        The validations of this run.

    Raises:
        FileError: if the checkpoint is there and ``resume`` is not asked for, or the reverse.
        DatasetError: if the two sets share frames, or no frame shows enough points.
    """
    out = Path(out)
    scenes, others = _scenes(datasets), _scenes(held_out)
    _require_apart(scenes, others)
    run = _resumed(out, device) if resume else _fresh(out, settings or TrainSettings(), device)
    checks = _validation_samples(others, run.settings)
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


def trusted_dataset(folder: Path, rig: Rig | None = None) -> Dataset:
    """A dataset whose rig holds extrinsics to train on.

    Args:
        folder: a KITTI odometry sequence, or a dataset folder.
        rig: the trusted one; if None, the sequence's calib.txt or the folder's reference.yaml.

    Raises:
        DatasetError: if the folder has neither: its rig.yaml is only a guess.
    """
    if rig is None and not (folder / kitti.CALIBRATION_NAME).is_file():
        reference = folder / REFERENCE_NAME
        if folder.is_dir() and not reference.is_file():
            raise DatasetError(
                f"{folder}: has no {REFERENCE_NAME}, and its rig.yaml is a guess; give the trusted "
                "extrinsic with --rig"
            )
        rig = load_rig(reference) if folder.is_dir() else None
    return load_dataset(folder, rig)


def split(datasets: Sequence[Dataset]) -> tuple[list[Dataset], list[Dataset]]:
    """The first four fifths of each dataset's frames, and the last: neighbours look alike.

    Raises:
        DatasetError: if one has a single frame.
    """
    for dataset in datasets:
        if len(dataset.frames) < 2:  # noqa: PLR2004
            raise DatasetError(
                f"{dataset.folders[0]}: one frame cannot be split; name others with --held-out"
            )
    cuts = [min(len(d.frames) - 1, -(-4 * len(d.frames) // 5)) for d in datasets]
    return (
        [replace(d, frames=d.frames[:cut]) for d, cut in zip(datasets, cuts, strict=True)],
        [replace(d, frames=d.frames[cut:]) for d, cut in zip(datasets, cuts, strict=True)],
    )


def parsed_crop(text: str) -> tuple[int, int] | None:
    """``320x960`` as height and width, ``none`` as None.

    Raises:
        ValueError: if it is neither.
    """
    if text == "none":
        return None
    parts = text.split("x")
    if len(parts) != 2 or not all(p.isdecimal() and int(p) >= 64 for p in parts):  # noqa: PLR2004
        raise ValueError(f"crop {text!r}: expected HxW in pixels, at least 64x64, or none")
    return int(parts[0]) // 2 * 2, int(parts[1]) // 2 * 2


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
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.network.parameters(), _GRADIENT_NORM)
        self.optimizer.step()
        self.step += 1
        return float(loss.detach())

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
            poses.append(_pose_error(scene, sample, found.cpu().numpy()))
        error, length = torch.cat(errors), torch.cat(lengths)
        return Validation(
            step=self.step,
            train_loss=train_loss,
            epe_px=float(error.mean()),
            median_px=float(error.median()),
            zero_px=float(length.mean()),
            **_pose_figures(samples, poses, self.settings),
        )

    def save(self, out: Path, validation: Validation) -> None:
        """Write the checkpoint."""
        content = {
            "config": _config(self.settings, validation),
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


def _pose_error(scene: Scene, sample: Sample, flow_px: NDArray[np.float32]) -> Array | None:
    """(6,) rotation [rad] and translation [m] of a frame's pose against the truth, or None."""
    camera = scene.camera.model_copy(update={"model": "pinhole", "distortion": ()})
    matches = Correspondences.from_arrays(
        camera="camera",
        frame=0,
        pixels_px=sample.pixels_px + flow_px,
        points_lidar_m=sample.points_camera_m,
    )
    step = max(1, -(-len(matches) // _PNP_MATCHES))
    T = frame_pose(camera, matches.select(slice(None, None, step)), Config())
    return None if T is None else _twist(T)


def _twist(T: Array) -> Array:
    return np.concatenate([Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3]])


def _pose_figures(
    samples: list[tuple[Scene, Sample]], poses: list[Array | None], settings: TrainSettings
) -> dict[str, float]:
    """The pose figures of a :class:`Validation`."""
    starts = np.array([_twist(sample.E) for _, sample in samples])
    solved = [pose for pose in poses if pose is not None]
    found = np.array(solved or [np.full(6, np.nan)])
    cameras: dict[str, list[Array]] = {}
    for (scene, _), pose in zip(samples, poses, strict=True):
        if pose is not None:
            cameras.setdefault(f"{scene.name} {scene.camera.intrinsics_px}", []).append(pose)
    shared = np.array([np.mean(each, axis=0) for each in cameras.values()] or [
        [math.radians(settings.rotation_deg)] * 3 + [settings.translation_m] * 3
    ])  # fmt: skip
    return {
        "pose_deg": float(np.degrees(np.median(np.linalg.norm(found[:, :3], axis=1)))),
        "pose_cm": float(100 * np.median(np.linalg.norm(found[:, 3:], axis=1))),
        "start_deg": float(np.degrees(np.median(np.linalg.norm(starts[:, :3], axis=1)))),
        "start_cm": float(100 * np.median(np.linalg.norm(starts[:, 3:], axis=1))),
        "failed_share": 1 - len(solved) / len(poses),
        "systematic_rotation_rad": float(np.sqrt(np.mean(shared[:, :3] ** 2))),
        "systematic_translation_m": float(np.sqrt(np.mean(shared[:, 3:] ** 2))),
    }


def _config(settings: TrainSettings, validation: Validation) -> dict[str, Any]:
    """What the checkpoint says of itself: the published files' keys, and our settings."""
    return {
        "use_reflectance": settings.reflectance,
        "normalize_images": True,
        "max_depth": settings.max_depth_m,
        "upsample_method": "transposed",
        "fourier_levels": settings.variant.fourier_levels,
        "context_encoder": settings.context,
        "uncertainty": False,
        "der_type": "NLL",
        "unc_freeze": False,
        "num_scales": 1,
        "al_contrario": False,
        "max_r": settings.rotation_deg,
        "max_t": settings.translation_m,
        **{f"train_{key}": value for key, value in asdict(settings).items()},
        "half_resolution": settings.half_resolution,
        "systematic_rotation_rad": validation.systematic_rotation_rad,
        "systematic_translation_m": validation.systematic_translation_m,
    }


def _fresh(out: Path, settings: TrainSettings, device: str) -> _Run:
    if out.exists():
        raise FileError(out, "is there already; go on with it (--resume), or choose another name")
    return _Run(settings, device)


def _resumed(out: Path, device: str) -> _Run:
    checkpoint = load_checkpoint(out)
    content = training_state(out)
    try:
        settings = _settings_of(content["config"])
        run = _Run(settings, device)
        run.network.load_state_dict(checkpoint.state)
        run.optimizer.load_state_dict(_tensors(content["optimizer"]))
        run.step = int(content["epoch"])
    except (KeyError, TypeError, ValueError) as error:
        raise FileError(out, f"is no checkpoint that training can go on with ({error})") from None
    if run.step >= settings.steps:
        raise FileError(out, f"has had all its {settings.steps} steps")
    return run


def _settings_of(config: Mapping[str, Any]) -> TrainSettings:
    said = {key.removeprefix("train_"): v for key, v in config.items() if key.startswith("train_")}
    if said["crop_px"] is not None:
        said["crop_px"] = tuple(said["crop_px"])
    return TrainSettings(**said)


def _tensors(content: Any) -> Any:
    """Nested plain data with its arrays as tensors of their own."""
    if isinstance(content, np.ndarray):
        return torch.tensor(np.array(content))
    if isinstance(content, dict):
        return {key: _tensors(value) for key, value in content.items()}
    if isinstance(content, list):
        return [_tensors(value) for value in content]
    return content


def _scenes(datasets: Sequence[Dataset]) -> list[Scene]:
    return [
        Scene(frame, name, camera)
        for dataset in datasets
        for frame in dataset.frames
        for name, camera in dataset.rig.cameras.items()
    ]


def _require_apart(scenes: Sequence[Scene], held_out: Sequence[Scene]) -> None:
    one, two = ({s.frame.cloud_path.resolve() for s in some} for some in (scenes, held_out))
    if both := one & two:
        raise DatasetError(
            f"{min(both)} is among the frames to train on and among those held out; hold out others"
        )


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


def _validation_samples(
    held_out: Sequence[Scene], settings: TrainSettings
) -> list[tuple[Scene, Sample]]:
    """The same for every call: every frame and camera, perturbed a few times."""
    rng = np.random.default_rng([settings.seed, 2**31])
    how = settings.samples(augment=False)
    made = [
        (scene, make_sample(scene, settings=how, variant=settings.variant, rng=rng))
        for scene in held_out
        for _ in range(_VALIDATION_DRAWS)
    ]
    samples = [(scene, sample) for scene, sample in made if sample is not None]
    if not samples:
        raise DatasetError("no held-out frame shows enough points in the image")
    return samples
