"""What an error bar consists of: the share of each source in its variance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class ErrorSources:
    """The sources of one camera's error bar, about its worst axis and along its worst axis.

    Attributes:
        rotation_deg: standard deviation about the axis where it is largest.
        translation_cm: the same along an axis.
        rotation: share of each source in the variance; they add up to 1.
        translation: likewise.
    """

    rotation_deg: float
    translation_cm: float
    rotation: Mapping[str, float] = field(default_factory=dict)
    translation: Mapping[str, float] = field(default_factory=dict)
