"""Clouds and gray images of the frames at hand, decoded once."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibgraph.io.dataset import Frame
from calibgraph.matching.structure.windows import Cloud
from calibgraph.model.rig import Camera

Version = tuple[Path, int, int]


class Decoded:
    """What has been decoded. A file that was written again since is decoded again."""

    def __init__(self) -> None:
        self._clouds: dict[Version, Cloud] = {}
        self._images: dict[tuple[Version, int, int], NDArray[np.uint8]] = {}

    def keep_only(self, frames: Iterable[Frame]) -> None:
        """Forget what is not of these frames: along a drive memory must not grow."""
        wanted = {path for f in frames for path in (f.cloud_path, *f.image_paths.values())}
        self._clouds = {key: value for key, value in self._clouds.items() if key[0] in wanted}
        self._images = {key: value for key, value in self._images.items() if key[0][0] in wanted}

    def cloud(self, frame: Frame) -> Cloud:
        """The frame's cloud."""
        key = _version(frame.cloud_path)
        if key not in self._clouds:
            self._clouds[key] = Cloud.of(frame.load_cloud())
        return self._clouds[key]

    def image(self, frame: Frame, name: str, camera: Camera) -> NDArray[np.uint8]:
        """(height, width) the camera's image, gray; its size is checked against the camera's."""
        key = (_version(frame.image_paths[name]), camera.width_px, camera.height_px)
        if key not in self._images:
            self._images[key] = frame.load_gray(name, camera)
        return self._images[key]


def _version(path: Path) -> Version:
    """A file as it is now; what is not there is for the decoder to complain of."""
    try:
        found = path.stat()
    except OSError:
        return path, 0, 0
    return path, found.st_mtime_ns, found.st_size
