"""Frames whose files are decoded once, though several parts of a calibration read them."""

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from calibgraph.io.burnt_in import BurntIn
from calibgraph.io.dataset import Dataset
from calibgraph.io.frame import Derived, Frame
from calibgraph.io.motion import ScanMotion
from calibgraph.memory import mmap_copy
from calibgraph.model.rig import Camera
from calibgraph.parallel import KeyedCache

Gray = NDArray[np.uint8]
Cloud = NDArray[np.float32]
Common = TypeVar("Common")

MAX_BYTES = 300_000_000
"""Of all that is kept of a dataset: 300 gray images of a megapixel."""


@dataclass(frozen=True, eq=False)
class KeptFrame(Frame):
    """A frame whose gray images, cloud and what derives of them are kept, unless others came since.

    None of them may be written to.

    Attributes:
        twist: (6,) of the LiDAR, in the place of that of the frame.
    """

    frame: Frame
    kept: KeyedCache[tuple[int, Hashable], Any]
    common: KeyedCache[Hashable, Any]
    twist: NDArray[np.float64] | None = None

    @property
    def motion(self) -> ScanMotion | None:
        """For which the cloud is corrected."""
        return self.frame.motion

    @property
    def is_corrected(self) -> bool:
        """Whether its cloud is corrected for motion."""
        return self.frame.is_corrected

    @property
    def twist_per_s(self) -> NDArray[np.float64] | None:
        """(6,) of the LiDAR."""
        return self.frame.twist_per_s if self.twist is None else self.twist

    def with_burnt_in(self, found: Mapping[str, BurntIn]) -> Frame:
        """The frame that was kept, whose images are filled: what was derived of them is not."""
        return self.frame.with_burnt_in(found)

    def load_cloud(self) -> Cloud:
        """(n, 4) x y z [m], intensity."""
        return self.derive("cloud", lambda: mmap_copy(self.frame.load_cloud()))

    def load_image(self, name: str, camera: Camera) -> Gray:
        """(height, width, 3) image, BGR; not kept."""
        return self.frame.load_image(name, camera)

    def load_gray(self, name: str, camera: Camera) -> Gray:
        """(height, width) the same image, gray."""
        return self.derive(("gray", name), lambda: mmap_copy(self.frame.load_gray(name, camera)))

    def derive(self, key: Hashable, make: Callable[[], Derived]) -> Derived:
        """What follows from its files and the key, made once."""
        value: Derived = self.kept.get((self.index, key), make)
        return value

    def derive_for_all(self, key: Hashable, make: Callable[[], Common]) -> Common:
        """What all frames of the dataset have in common, made once. It bounds its own memory."""
        value: Common = self.common.get(key, make)
        return value

    def hashes(self) -> dict[str, str]:
        """SHA-256 of the cloud and the images, by path."""
        return self.derive_for_all(("hashes", self.index), self.frame.hashes)

    def entry(self) -> dict[str, Any]:
        """The frame's number and files, as a result keeps them."""
        return self.frame.entry()


def keep_frames(data: Dataset) -> Dataset:
    """The dataset with frames whose files are decoded once.

    Only the frames themselves, not the others that were recorded.
    """
    if any(isinstance(frame, KeptFrame) for frame in data.frames):
        return data
    kept: KeyedCache[tuple[int, Hashable], Any] = KeyedCache(MAX_BYTES)
    common: KeyedCache[Hashable, Any] = KeyedCache()
    frames = (
        KeptFrame(
            each.index, each.name, each.cloud_path, each.image_paths,
            frame=each, burnt_in=each.burnt_in, kept=kept, common=common,
        )
        for each in data.frames
    )  # fmt: skip
    return replace(data, frames=tuple(frames))
