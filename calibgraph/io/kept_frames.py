"""Frames whose files are decoded once, though several parts of a calibration read them."""

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from calibgraph.io.dataset import Dataset
from calibgraph.io.frame import Derived, Frame
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
    """

    kept: KeyedCache[tuple[int, Hashable], Any] = field(kw_only=True)
    common: KeyedCache[Hashable, Any] = field(kw_only=True)

    def load_cloud(self) -> Cloud:
        """(n, 4) x y z [m], intensity."""
        load = super().load_cloud
        return self.derive("cloud", lambda: mmap_copy(load()))

    def load_gray(self, name: str, camera: Camera) -> Gray:
        """(height, width) the same image, gray."""
        load = super().load_gray
        return self.derive(("gray", name), lambda: mmap_copy(load(name, camera)))

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
        return self.derive_for_all(("hashes", self.index), super().hashes)


def keep_frames(data: Dataset) -> Dataset:
    """The dataset with frames whose files are decoded once.

    Only the frames themselves, not the others that were recorded.
    """
    if any(isinstance(frame, KeptFrame) for frame in data.frames):
        return data
    kept: KeyedCache[tuple[int, Hashable], Any] = KeyedCache(MAX_BYTES)
    common: KeyedCache[Hashable, Any] = KeyedCache()
    names = [each.name for each in fields(Frame)]
    frames = (
        KeptFrame(**{name: getattr(each, name) for name in names}, kept=kept, common=common)
        for each in data.frames
    )
    return replace(data, frames=tuple(frames))
