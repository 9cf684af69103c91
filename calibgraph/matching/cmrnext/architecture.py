"""The architecture of a checkpoint's network: recognised from shapes, compared with its config."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

Shapes = Mapping[str, tuple[int, ...]]

FULL_WIDTH = 64
"""Channels of the published networks' first layer; every other width follows it in proportion."""

_UNCERTAINTY_OF_OUTPUTS = {2: "none", 4: "nll"}
_DER_OUTPUTS = (6, 8)
_RGB = 3
_MAX_WIDTH = 256


@dataclass(frozen=True)
class Architecture:
    """The dimensions that differ between CMRNext networks.

    Attributes:
        fourier_levels: of the depth encoding; -1: plain depth.
        reflectance: whether the LiDAR image has a channel of intensities.
        context: which image the context encoder reads.
        uncertainty: ``nll``: the flow head also predicts standard deviations; ``nll_frozen``: a
            second update block does.
        width: channels of the first layer, a multiple of 8; published networks have 64.
    """

    fourier_levels: int = 12
    reflectance: bool = False
    context: Literal["lidar", "rgb"] = "lidar"
    uncertainty: Literal["none", "nll", "nll_frozen"] = "none"
    width: int = FULL_WIDTH

    def __post_init__(self) -> None:
        if not 8 <= self.width <= _MAX_WIDTH or self.width % 8:  # noqa: PLR2004 - all parts whole
            raise ValueError(
                f"network width {self.width}: expected a multiple of 8 up to {_MAX_WIDTH}"
            )
        if not (self.fourier_levels == -1 or 1 <= self.fourier_levels <= 20):  # noqa: PLR2004
            raise ValueError(f"fourier_levels {self.fourier_levels}: expected 1 to 20, or -1")

    @property
    def lidar_channels(self) -> int:
        """Channels of the LiDAR input: 2L + 1, or 1 without encoding; 1 more with reflectance."""
        return 2 * max(self.fourier_levels, 0) + 1 + self.reflectance

    @property
    def context_channels(self) -> int:
        """Channels of the context encoder's input."""
        return self.lidar_channels if self.context == "lidar" else _RGB

    def scale(self, channels: int) -> int:
        """A layer's channels, scaled from the published width."""
        return channels * self.width // FULL_WIDTH


def recognize_architecture(shapes: Shapes, *, reflectance: bool) -> Architecture:
    """The architecture that a state dict's shapes belong to.

    Raises:
        ValueError: if they belong to no supported architecture.
    """
    lidar = _dimension(shapes, "fnet_lidar.conv1.weight", 1)
    context = _dimension(shapes, "cnet.conv1.weight", 1)
    uncertainty = _recognize_uncertainty(shapes)
    if context not in (_RGB, lidar):
        raise ValueError(f"its context encoder reads {context} channels, expected 3 or {lidar}")
    encoding = lidar - reflectance
    if encoding < 1 or encoding % 2 == 0:
        raise ValueError(
            f"its LiDAR encoder reads {lidar} channels, which does not fit its config's "
            f"use_reflectance {reflectance}"
        )
    return Architecture(
        fourier_levels=(encoding - 1) // 2 or -1,
        reflectance=reflectance,
        context="lidar" if context == lidar else "rgb",
        uncertainty=uncertainty,  # type: ignore[arg-type]
        width=_dimension(shapes, "fnet_img.conv1.weight", 0),
    )


def _recognize_uncertainty(shapes: Shapes) -> str:
    outputs = _dimension(shapes, "update_block.flow_head.conv2.weight", 0)
    if any(name.startswith("update_block_unc.") for name in shapes):
        head = _dimension(shapes, "update_block_unc.flow_head.conv2.weight", 0)
        uncertainty = "nll_frozen" if (outputs, head) == (2, 2) else None
        outputs = head if outputs == 2 else outputs  # noqa: PLR2004 - the plain head
    else:
        uncertainty = _UNCERTAINTY_OF_OUTPUTS.get(outputs)
    if uncertainty is None:
        kind = "an evidential (DER)" if outputs in _DER_OUTPUTS else "an unknown"
        raise ValueError(
            f"has {kind} uncertainty head of {outputs} outputs, which is not supported"
        )
    return uncertainty


def require_config_agrees(architecture: Architecture, config: Mapping[str, Any]) -> None:
    """Compare a checkpoint's config with the architecture of its weights.

    Raises:
        ValueError: on the first disagreement.
    """
    head = {"none": False, "nll": True, "nll_frozen": True}[architecture.uncertainty]
    of_weights = {
        "fourier_levels": architecture.fourier_levels,
        "context_encoder": architecture.context,
        "uncertainty": head,
        "unc_freeze": architecture.uncertainty == "nll_frozen",
        "al_contrario": False,
    }
    defaults = {"fourier_levels": -1, "context_encoder": "rgb"}
    for key, actual in of_weights.items():
        given = config.get(key, defaults.get(key, False))
        if key == "unc_freeze" and not head:
            continue
        if given != actual:
            raise ValueError(f"its config has {key} = {given!r}, its weights have {actual!r}")


def _dimension(shapes: Shapes, name: str, axis: int) -> int:
    if name not in shapes:
        raise ValueError(f"lacks {name!r}: these are not the weights of a CMRNext network")
    if len(shapes[name]) != 4:  # noqa: PLR2004 - a convolution
        raise ValueError(f"{name!r} has shape {shapes[name]}, expected a convolution's")
    return shapes[name][axis]
