"""Frames whose files are decoded once, though several parts of an audit read them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.io.dataset import Dataset
from calibgraph.io.frame import Frame
from calibgraph.io.motion import ScanMotion
from calibgraph.memory import keep
from calibgraph.model.rig import Camera
from calibgraph.parallel import Once

Gray = NDArray[np.uint8]
Cloud = NDArray[np.float32]

MAX_BYTES = 300_000_000
"""Of the images and of the clouds that are kept, each: 300 gray images of a megapixel."""


@dataclass(frozen=True, eq=False)
class Kept:
    """Decoded images and clouds of a dataset, those used last."""

    images: Once[tuple[int, str], Gray] = field(default_factory=Once)
    clouds: Once[int, Cloud] = field(default_factory=Once)


@dataclass(frozen=True, eq=False)
class KeptFrame(Frame):
    """A frame whose gray images and cloud are kept. None of them may be written to.

    Attributes:
        frame: that reads them.
        kept: of all frames of its dataset.
    """

    frame: Frame
    kept: Kept

    @property
    def motion(self) -> ScanMotion | None:
        """For which the cloud is corrected."""
        return self.frame.motion

    def load_cloud(self) -> Cloud:
        """(n, 4) x y z [m], intensity."""
        cloud = self.kept.clouds.get(self.index, lambda: keep(self.frame.load_cloud()))
        self.kept.clouds.keep_last(MAX_BYTES, lambda each: each.nbytes)
        return cloud

    def load_image(self, name: str, camera: Camera) -> Gray:
        """(height, width, 3) image, BGR; not kept."""
        return self.frame.load_image(name, camera)

    def load_gray(self, name: str, camera: Camera) -> Gray:
        """(height, width) the same image, gray."""
        key = self.index, name
        image = self.kept.images.get(key, lambda: keep(self.frame.load_gray(name, camera)))
        self.kept.images.keep_last(MAX_BYTES, lambda each: each.nbytes)
        return image

    def hashes(self) -> dict[str, str]:
        """SHA-256 of the cloud and the images, by path."""
        return self.frame.hashes()

    def entry(self) -> dict[str, Any]:
        """The frame's number and files, as a result keeps them."""
        return self.frame.entry()


def keep_frames(data: Dataset) -> Dataset:
    """The dataset with frames whose files are decoded once.

    Only the frames themselves: the others that were recorded are not read.
    """
    kept = Kept()
    frames = (
        KeptFrame(each.index, each.name, each.cloud_path, each.image_paths, frame=each, kept=kept)
        for each in data.frames
    )
    return replace(data, frames=tuple(frames))
