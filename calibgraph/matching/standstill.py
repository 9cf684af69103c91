"""Stationary frames: while the vehicle stands, all frames show the same and share one error."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.io.dataset import Dataset
from calibgraph.io.frame import Frame
from calibgraph.model.rig import Rig

Gray = NDArray[np.uint8]

STATIONARY_PX = 0.5
"""Median image motion of the recorded image, below which a camera stands: matches are less
precise, so they share one error."""

_SCALE = 2  # times smaller than recorded, for speed; flow is good to some hundredths of a pixel
_FEATURES, _MIN_FEATURES = 200, 20
_SPACING_PX, _QUALITY = 8, 0.01
_THUMB = (32, 12)
_ALIKE = 5.0  # median difference of thumbnails: on recordings 0 to 3 standing, from 3 driving
_TRACKED = 0.5  # share of the features that must be found again
_RETURN_PX = 0.5  # a feature tracked forth and back must end this near


@dataclass(frozen=True, eq=False)
class View:
    """A camera's image, for comparison.

    Attributes:
        image: gray, made smaller.
        thumb: (n,) of its brightness.
        corners: (n, 1, 2) features.
    """

    image: Gray
    thumb: NDArray[np.float64]
    corners: NDArray[np.float32]

    @staticmethod
    def from_image(gray: Gray) -> View:
        """Prepare a (height, width) image as recorded."""
        size = (gray.shape[1] // _SCALE, gray.shape[0] // _SCALE)
        image = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
        thumb = cv2.resize(image, _THUMB, interpolation=cv2.INTER_AREA).astype(np.float64).ravel()
        corners = cv2.goodFeaturesToTrack(image, _FEATURES, _QUALITY, _SPACING_PX)
        found = np.empty((0, 1, 2), np.float32) if corners is None else corners
        return View(
            np.asarray(image, dtype=np.uint8),
            thumb,
            np.asarray(found, dtype=np.float32),
        )

    def stands(self, later: View) -> bool | None:
        """Whether the camera has not moved until another image; None if neither can tell."""
        if self.image.shape != later.image.shape:
            return False
        if len(self.corners) < _MIN_FEATURES:
            return None
        difference = later.thumb - self.thumb
        if np.median(np.abs(difference - np.median(difference))) > _ALIKE:
            return False
        there, found, _ = cv2.calcOpticalFlowPyrLK(self.image, later.image, self.corners, None)  # type: ignore[call-overload]
        back, returned, _ = cv2.calcOpticalFlowPyrLK(later.image, self.image, there, None)  # type: ignore[call-overload]
        good = (found * returned).ravel().astype(bool)
        good &= np.linalg.norm((back - self.corners)[:, 0], axis=1) < _RETURN_PX
        if good.mean() < _TRACKED:
            return False
        motion = np.linalg.norm((there - self.corners)[good, 0], axis=1)
        return bool(_SCALE * np.median(motion) < STATIONARY_PX)


def find_stationary_frames(dataset: Dataset, rig: Rig) -> list[list[int]]:
    """The frame numbers of every stop that has several frames.

    Two frames are of one stop if the median image motion is below ``STATIONARY_PX`` in every
    camera; moving traffic may fill less than half of an image.

    Raises:
        FileError: if an image cannot be read.
    """
    stops: list[tuple[_Views, list[int]]] = []
    for frame in dataset.frames:
        views = _Views(frame, rig)
        members = next((found for first, found in stops if first.is_stationary(views)), None)
        if members is None:
            stops.append((views, [frame.index]))
        else:
            members.append(frame.index)
    return [members for _, members in stops if len(members) > 1]


class _Views:
    """The views of a frame's cameras, each made when it is first needed."""

    def __init__(self, frame: Frame, rig: Rig) -> None:
        self._frame, self._rig = frame, rig
        self._views: dict[str, View] = {}

    def view(self, name: str) -> View:
        if name not in self._views:
            gray = self._frame.load_gray(name, self._rig.cameras[name])
            self._views[name] = View.from_image(gray)
        return self._views[name]

    def is_stationary(self, later: _Views) -> bool:
        """Whether no camera has moved, and at least one can tell."""
        names = [name for name in self._rig.cameras if self._sees(name) and later._sees(name)]
        return _none_moved(self.view(name).stands(later.view(name)) for name in names)

    def _sees(self, name: str) -> bool:
        return name in self._frame.image_paths


def _none_moved(stand: Iterable[bool | None]) -> bool:
    """Whether none is False and some are True; ends at the first that is False."""
    any_can_tell = False
    for stands in stand:
        if stands is False:
            return False
        any_can_tell |= stands is True
    return any_can_tell
