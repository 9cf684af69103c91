"""Events: what moved, since when, how far; and cameras without usable matches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from calibgraph.arrays import Array

Kind = Literal["started", "moved", "drifts", "blind", "back"]


@dataclass(frozen=True)
class Size:
    """Size of a move, with its standard deviations.

    Attributes:
        rotation_deg: angle.
        translation_cm: length.
        rotation_sigma_deg, translation_sigma_cm: standard deviations along these directions.
    """

    rotation_deg: float
    translation_cm: float
    rotation_sigma_deg: float
    translation_sigma_cm: float

    @staticmethod
    def of(step: Array, covariance: Array) -> Size:
        """The size of a (6,) tangent step with its (6, 6) covariance."""
        rotation, translation = (
            _length_and_sigma(step[rows], covariance[rows, rows])
            for rows in (slice(0, 3), slice(3, 6))
        )
        return Size(
            rotation_deg=float(np.degrees(rotation[0])),
            translation_cm=100 * translation[0],
            rotation_sigma_deg=float(np.degrees(rotation[1])),
            translation_sigma_cm=100 * translation[1],
        )

    def __str__(self) -> str:
        """With units."""
        return (
            f"{self.rotation_deg:.3g} +- {self.rotation_sigma_deg:.2g} deg and "
            f"{self.translation_cm:.3g} +- {self.translation_sigma_cm:.2g} cm"
        )


def _length_and_sigma(step: Array, covariance: Array) -> tuple[float, float]:
    length = float(np.linalg.norm(step))
    direction = step / length if length else np.full(3, 3**-0.5)
    return length, float(np.sqrt(direction @ covariance @ direction))


@dataclass(frozen=True)
class Event:
    """An event of the drive, for the user.

    Attributes:
        kind: ``started``: a camera has its first estimate; ``moved``: it stepped; ``drifts``: it
            moves slowly, and is followed; ``blind``: no usable matches for a while; ``back``:
            usable matches again.
        camera: its name; None: the LiDAR, under all cameras.
        frame: number of the first frame of the event.
        detected_frame: number of the frame at which it was detected.
        stamp_ns: time of that frame, or None.
        size: of a move, in the camera's (the LiDAR's) own frame.
    """

    kind: Kind
    camera: str | None
    frame: int
    detected_frame: int
    stamp_ns: int | None = None
    size: Size | None = None

    def __str__(self) -> str:
        """One sentence."""
        who = "the LiDAR" if self.camera is None else f"camera {self.camera!r}"
        text = f"{who} {_TEXTS[self.kind]} since frame {self.frame}"
        return text if self.size is None else f"{text}, by {self.size}"


_TEXTS: dict[Kind, str] = {
    "started": "has an estimate of its own",
    "moved": "has moved",
    "drifts": "drifts",
    "blind": "has no usable matches",
    "back": "has usable matches again",
}
