"""What to train, and on what; and how a checkpoint says so."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from calibgraph.errors import FileError
from calibgraph.files import describe
from calibgraph.matching.cmrnext.architecture import FULL_WIDTH, Variant
from calibgraph.matching.cmrnext.checkpoint import Checkpoint
from calibgraph.matching.cmrnext.samples import SampleSettings
from calibgraph.matching.cmrnext.training.validation import Validation
from calibgraph.model.config import Seed

Count = Annotated[int, Field(ge=1, le=10**9)]
CropSize = Annotated[int, Field(ge=64, le=100_000)]


class TrainSettings(BaseModel):
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

    model_config = ConfigDict(extra="forbid", frozen=True)

    rotation_deg: Annotated[float, Field(gt=0, le=180)] = 20.0
    translation_m: Annotated[float, Field(gt=0, le=1000)] = 1.5
    steps: Count = 100_000
    batch: Annotated[int, Field(ge=1, le=1024)] = 4
    iterations: Annotated[int, Field(ge=1, le=100)] = 12
    learning_rate: Annotated[float, Field(gt=0, le=1)] = 3e-4
    warm_up_share: Annotated[float, Field(ge=0.01, le=0.99)] = 0.4
    correlation_weight: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    correlation_steps: Annotated[int, Field(ge=0, le=10**9)] = 0
    crop_px: tuple[CropSize, CropSize] | None = (320, 960)
    half_resolution: bool = False
    width: int = FULL_WIDTH
    fourier_levels: int = 12
    reflectance: bool = False
    context: Literal["lidar", "rgb"] = "lidar"
    max_depth_m: Annotated[float, Field(ge=1, le=10_000)] = 160.0
    seed: Seed = 0

    @model_validator(mode="after")
    def _can_be_trained(self) -> Self:
        _ = self.variant
        if self.correlation_steps and not self.correlation_weight:
            raise ValueError("correlation_steps need a correlation_weight above 0")
        return self

    def changed(self, **settings: Any) -> TrainSettings:
        """A checked copy with some settings changed.

        Raises:
            ValueError: on an unknown setting or a wrong value, in one line.
        """
        return _checked({**self.model_dump(), **settings})

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


def config_of(settings: TrainSettings, validation: Validation) -> dict[str, Any]:
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
        **{f"train_{key}": value for key, value in settings.model_dump().items()},
        "half_resolution": settings.half_resolution,
        "systematic_rotation_rad": validation.systematic_rotation_rad,
        "systematic_translation_m": validation.systematic_translation_m,
    }


def settings_in(config: Mapping[str, Any]) -> TrainSettings:
    """The settings in a config that :func:`config_of` made.

    Raises:
        ValueError: if it was made otherwise.
    """
    prefix = "train_"
    said = {key.removeprefix(prefix): v for key, v in config.items() if key.startswith(prefix)}
    if not said:
        raise ValueError("it was not made by calibgraph train; start from it with --from")
    if missing := TrainSettings.model_fields.keys() - said.keys():
        raise ValueError(f"its config lacks a sound {prefix}{min(missing)}")
    return _checked(said)


def _checked(settings: Mapping[str, Any]) -> TrainSettings:
    try:
        return TrainSettings.model_validate(settings)
    except ValidationError as error:
        raise ValueError(describe(error)) from error


def settings_from(settings: TrainSettings, checkpoint: Checkpoint) -> TrainSettings:
    """The settings with the network of the weights that training starts from.

    Raises:
        FileError: if they cannot be trained.
    """
    variant = checkpoint.variant
    if variant.uncertainty != "none" or not checkpoint.config["normalize_images"]:
        raise FileError(
            checkpoint.path,
            "has an uncertainty head or reads images that are not normalised: training such a "
            "network is not supported; start from plain weights",
        )
    return settings.changed(
        width=variant.width,
        fourier_levels=variant.fourier_levels,
        reflectance=variant.reflectance,
        context=variant.context,
        max_depth_m=checkpoint.max_depth_m,
    )
