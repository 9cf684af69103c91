"""Settings of a training: from a YAML file, and in the checkpoint's config."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from calibgraph.errors import FileError
from calibgraph.files import describe, write_yaml
from calibgraph.matching.cmrnext.architecture import FULL_WIDTH, Architecture
from calibgraph.matching.cmrnext.checkpoint import Checkpoint
from calibgraph.model.config import Seed
from calibgraph.outputs import yaml_mark

Count = Annotated[int, Field(ge=1, le=10**9)]
CropSize = Annotated[int, Field(ge=64, le=100_000, multiple_of=2)]

CONFIG_PREFIX = "train_"
"""Of the settings in a checkpoint's config."""


class TrainSettings(BaseModel):
    """Settings of a training. All of them are written into the checkpoint."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    rotation_deg: Annotated[float, Field(gt=0, le=180)] = 20.0
    """Largest perturbation per axis, uniform: the network's range."""
    translation_m: Annotated[float, Field(gt=0, le=1000)] = 1.5
    """Largest perturbation per axis, uniform: the network's range."""
    steps: Count = 100_000
    """Optimizer steps in all."""
    batch: Annotated[int, Field(ge=1, le=1024)] = 4
    """Samples per step."""
    iterations: Annotated[int, Field(ge=1, le=100)] = 12
    """Iterations of the recurrent update in training."""
    learning_rate: Annotated[float, Field(gt=0, le=1)] = 3e-4
    """Peak of the one-cycle schedule."""
    warm_up_share: Annotated[float, Field(ge=0.01, le=0.99)] = 0.4
    """Share of the steps before that peak."""
    correlation_weight: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    """Weight of an additional loss on the encoders: cross-entropy of the correlation at the true
    cell. The published training has none. With 0.3, short trainings need not wait for the
    gradients of the flow to reach the encoders."""
    correlation_steps: Annotated[int, Field(ge=0, le=10**9)] = 0
    """Steps at the beginning with that loss alone."""
    pose_weight: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    """Weight of an additional loss on the pose that minimizes the factor graph of the matches: its
    negative log-likelihood, differentiated through the optimum. For fine-tuning (`--from`)."""
    crop_px: tuple[CropSize, CropSize] | None = (320, 960)
    """Height and width of random crops at full resolution, even numbers; null for whole images."""
    half_resolution: bool = False
    """Halve the images."""
    width: int = FULL_WIDTH
    """Channels of the network's first layer, a multiple of 8; 64 as published."""
    fourier_levels: int = 12
    """Levels of the depth's Fourier encoding; -1 for plain depth."""
    reflectance: bool = False
    """Whether the network also reads the LiDAR's intensity."""
    context: Literal["lidar", "rgb"] = "lidar"
    """Which image the context encoder reads: lidar or rgb."""
    max_depth_m: Annotated[float, Field(ge=1, le=10_000)] = 160.0
    """Divisor of depths."""
    seed: Seed = 0
    """Seed of the initial weights and of all samples."""

    @model_validator(mode="after")
    def _require_trainable(self) -> Self:
        _ = self.architecture
        if self.correlation_steps and not self.correlation_weight:
            raise ValueError("correlation_steps need a correlation_weight above 0")
        return self

    def changed(self, **settings: Any) -> TrainSettings:
        """A checked copy with some settings changed.

        Raises:
            ValueError: on an unknown setting or a wrong value, in one line.
        """
        return _validate({**self.model_dump(), **settings})

    @property
    def architecture(self) -> Architecture:
        """The architecture of the network."""
        return Architecture(
            fourier_levels=self.fourier_levels,
            reflectance=self.reflectance,
            context=self.context,
            width=self.width,
        )

    def save(self, path: Path) -> None:
        """Write all settings as YAML."""
        write_yaml(path, self.model_dump(), first_line=yaml_mark("train"))


def settings_of(config: Mapping[str, Any]) -> TrainSettings:
    """The settings in the config of a training.

    Raises:
        ValueError: if it is none.
    """
    given = {
        key.removeprefix(CONFIG_PREFIX): config[key]
        for key in config
        if key.startswith(CONFIG_PREFIX)
    }
    if not given:
        raise ValueError("it was not made by calibgraph train; start from it with --from")
    if missing := TrainSettings.model_fields.keys() - given.keys():
        raise ValueError(f"its config lacks a sound {CONFIG_PREFIX}{min(missing)}")
    return _validate(given)


def adopt_architecture(settings: TrainSettings, checkpoint: Checkpoint) -> TrainSettings:
    """The settings with the network of the weights from which training starts.

    Raises:
        FileError: if they cannot be trained.
    """
    architecture = checkpoint.architecture
    if architecture.uncertainty != "none" or not checkpoint.config["normalize_images"]:
        raise FileError(
            checkpoint.path,
            "has an uncertainty head or reads images that are not normalised: training such a "
            "network is not supported; start from plain weights",
        )
    return settings.changed(
        width=architecture.width,
        fourier_levels=architecture.fourier_levels,
        reflectance=architecture.reflectance,
        context=architecture.context,
        max_depth_m=checkpoint.max_depth_m,
    )


def _validate(settings: Mapping[str, Any]) -> TrainSettings:
    try:
        return TrainSettings.model_validate(settings)
    except ValidationError as error:
        raise ValueError(describe(error)) from error
