"""What is read of a bag, and how its images are paired with its clouds."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Literal, get_args

Stamps = Literal["header", "record"]
Motion = Literal["none", "odometry", "tf", "scans"]
NEAR_S = 0.05
"""Largest difference of the stamps of a cloud and its images, if none is given: half a turn of a
LiDAR at 10 Hz, so that streams of equal rates pair, whatever their phase."""
LIDAR, ODOMETRY = "lidar", "odometry"
"""The keys of the clouds' topic and of the odometry's in :attr:`BagOptions.topics`."""


@dataclass(frozen=True, kw_only=True)
class BagOptions:
    """What is read of a bag.

    Attributes:
        topics: the clouds' topic under ``lidar``, and image topics by camera name,
            and that of the ``odometry``; those that are
            not given are found by their types.
        every_s: seconds between frames; only their surroundings are read. All frames if None.
        sync_tolerance_s: largest difference of the stamps of a cloud and its images, also of
            folders whose files are named by stamps.
        stamps: ``header``, those of the sensors; or ``record``, when a message was recorded, for
            sensors whose clocks differ.
        motion: how clouds are corrected for the motion of the vehicle, to the median stamp of a
            frame's images: by Odometry, by /tf, by registration of neighbouring scans; or
            ``none``: they are as recorded, or corrected already.
        beside: further bags of the drive, whose static transforms and lenses serve where the bag
            has none: those that are loaded together with it.

    Raises:
        ValueError: if a value is out of range.
    """

    topics: Mapping[str, str] = field(default_factory=dict)
    every_s: float | None = None
    sync_tolerance_s: float = NEAR_S
    stamps: Stamps = "header"
    motion: Motion = "none"
    beside: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "topics", MappingProxyType(dict(self.topics)))
        if self.every_s is not None and not self.every_s > 0:
            raise ValueError(f"every_s must be positive, found {self.every_s}")
        if not self.sync_tolerance_s >= 0:
            raise ValueError(
                f"sync_tolerance_s must not be negative, found {self.sync_tolerance_s}"
            )
        if self.stamps not in get_args(Stamps):
            raise ValueError(f"stamps {self.stamps!r}: known are {', '.join(get_args(Stamps))}")
        if self.motion not in get_args(Motion):
            raise ValueError(f"motion {self.motion!r}: known are {', '.join(get_args(Motion))}")
        if self.motion != "none" and self.stamps != "header":
            raise ValueError("motion is corrected by the stamps of the headers; leave out stamps")
