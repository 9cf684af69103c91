"""Choose the frames of a long recording that are matched: distant places, sharp and bright.

While the vehicle stands, all frames show the same and share one error: stationary frames.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CalibrationError
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.io.frame import Frame
from calibgraph.model.rig import Rig
from calibgraph.parallel import map_on_cores

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
    stops: list[tuple[Frame, Callable[[str], View], list[int]]] = []
    for frame in dataset.frames:
        view = cache(partial(_view, frame, rig))
        for first, seen, members in stops:
            names = [n for n in rig.cameras if n in first.image_paths and n in frame.image_paths]
            if _none_moved(seen(name).stands(view(name)) for name in names):
                members.append(frame.index)
                break
        else:
            stops.append((frame, view, [frame.index]))
    return [members for _, _, members in stops if len(members) > 1]


def _view(frame: Frame, rig: Rig, name: str) -> View:
    return View.from_image(frame.load_gray(name, rig.cameras[name]))


def _none_moved(stand: Iterable[bool | None]) -> bool:
    """Whether none is False and some are True; ends at the first that is False."""
    any_can_tell = False
    for stands in stand:
        if stands is False:
            return False
        any_can_tell |= stands is True
    return any_can_tell


CANDIDATES = 3
"""Frames whose images are read, per chosen frame: there is a clear one in three, unless
a lens is covered, and more would take longer than the matching."""


@dataclass(frozen=True, eq=False)
class FrameChoice:
    """Some frames of a dataset.

    Attributes:
        dataset: these frames.
        text: how they were chosen; empty for all of them.
        copies: names of the frames that were left out as copies, each with that of its original.
    """

    dataset: Dataset
    text: str = ""
    copies: tuple[tuple[str, str], ...] = ()


_Seen = tuple[NDArray[np.float64], tuple[int, View] | None]
"""Of a frame: (cameras,) mean gradient of each image, which blur and darkness lower, NaN if it
cannot be read; the view of the first camera that can be, with its place in the rig."""


def without_copies(dataset: Dataset) -> FrameChoice:
    """The dataset with one of the frames that have the same cloud and the same images.

    A search would take what one frame shows by chance for the agreement of many.
    """
    contents = map_on_cores(_content, dataset.frames)
    kept = dict[Hashable, Frame]()
    originals = [kept.setdefault(*each) for each in zip(contents, dataset.frames, strict=True)]
    pairs = zip(dataset.frames, originals, strict=True)
    copies = tuple((frame.name, first.name) for frame, first in pairs if frame is not first)
    return FrameChoice(dataset.only([*kept.values()]) if copies else dataset, copies=copies)


def _content(frame: Frame) -> Hashable:
    """Equal for copies; a frame with a file that cannot be read is none."""
    try:
        hashes = frame.hashes()
    except (CalibrationError, OSError):
        return frame.index
    images = sorted((name, hashes[str(path)]) for name, path in frame.image_paths.items())
    return hashes[str(frame.cloud_path)], *images


def choose_frames(dataset: Dataset, rig: Rig, most: int) -> FrameChoice:
    """Choose frames spread over the recording, without copies; all if there are no more.

    While the vehicle stands, one is taken. Of neighbours, that with the clearest images is: the
    largest product over the cameras of their images' mean gradient.
    """
    unique = without_copies(dataset.spread_out(CANDIDATES * most))
    frames = unique.dataset.frames
    if len(frames) <= most:
        return unique
    candidates = map_on_cores(_examine, frames, [rig] * len(frames))
    scores = _scores(candidates)
    places = list(_places(candidates))
    best = [max(place, key=scores.__getitem__) for place in places]
    parts = np.array_split(best, min(most, len(best)))
    chosen = {int(max(part, key=scores.__getitem__)) for part in parts}
    rest = [number for number in range(len(frames)) if number not in chosen]
    chosen.update(spread_out(rest, most - len(chosen)))  # stands: they count as one, but are there
    text = (
        f"{most} of {len(dataset.frames)} frames are matched (--frames chooses others): of "
        f"{len(frames)} evenly spread, the clearest of neighbours"
    )
    standing, unread = len(frames) - len(places), int(np.isneginf(scores).sum())
    text += f"; in {standing} the vehicle stands where it stood" if standing else ""
    text += f"; {unread} have an image that cannot be read" if unread else ""
    kept = dataset.only([frames[number] for number in sorted(chosen)])
    return FrameChoice(kept, text, unique.copies)


def _examine(frame: Frame, rig: Rig) -> _Seen:
    clarity, view = np.full(len(rig.cameras), np.nan), None
    for index, (name, camera) in enumerate(rig.cameras.items()):
        try:
            gray = frame.load_gray(name, camera)
        except (CalibrationError, OSError, KeyError):
            continue
        # At half the size noise is less, and edges are as sharp.
        half = cv2.resize(gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        along = cv2.spatialGradient(half)
        clarity[index] = sum(cv2.norm(each, cv2.NORM_L1) for each in along) / half.size
        view = view or (index, View.from_image(gray))
    return clarity, view


def _scores(candidates: Sequence[_Seen]) -> NDArray[np.float64]:
    """(n,) the sum over cameras of log clarity: -inf where an image is missing.

    The scene that a camera mostly sees does not count: it adds the same to all candidates.
    """
    clarity = np.array([each for each, _ in candidates])
    seeing = np.nan_to_num(clarity).max(axis=0) > 0.0  # the others are covered, or have no images
    logs = np.log(np.maximum(clarity[:, seeing], np.finfo(np.float64).tiny))  # NaN stays
    scores: NDArray[np.float64] = np.where(np.isnan(logs), -np.inf, logs).sum(axis=1)
    return scores


def _places(candidates: Sequence[_Seen]) -> Iterator[list[int]]:
    """Runs of candidates during which the vehicle stands."""
    place = [0]
    for (_, (_, before)), (number, (_, now)) in pairwise(enumerate(candidates)):
        if before and now and before[0] == now[0] and before[1].stands(now[1]) is True:
            place.append(number)
        else:
            yield place
            place = [number]
    yield place
