"""Choose the frames of a long recording that are matched: distant places, sharp and bright."""

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CalibrationError
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.io.frame import Frame
from calibgraph.matching.standstill import View
from calibgraph.model.rig import Rig
from calibgraph.parallel import map_on_cores

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


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A frame that may be chosen.

    Attributes:
        clarity: (cameras,) mean gradient of each image, which blur and darkness lower; NaN if it
            cannot be read.
        view: of the first camera that can be read, with its place in the rig; None without any.
    """

    frame: Frame
    clarity: NDArray[np.float64]
    view: tuple[int, View] | None


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


def _examine(frame: Frame, rig: Rig) -> _Candidate:
    clarity, view = np.full(len(rig.cameras), np.nan), None
    for index, (name, camera) in enumerate(rig.cameras.items()):
        try:
            gray = frame.load_gray(name, camera)
        except (CalibrationError, OSError, KeyError):
            continue
        clarity[index] = _clarity(gray)
        view = view or (index, View.from_image(gray))
    return _Candidate(frame, clarity, view)


def _clarity(gray: NDArray[np.uint8]) -> float:
    """Mean gradient of the image at half its size, where noise is less and edges are as sharp."""
    half = cv2.resize(gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    along_x, along_y = cv2.spatialGradient(half)
    return float(cv2.norm(along_x, cv2.NORM_L1) + cv2.norm(along_y, cv2.NORM_L1)) / half.size


def _scores(candidates: Sequence[_Candidate]) -> NDArray[np.float64]:
    """(n,) the sum over cameras of log clarity: -inf where an image is missing.

    The scene that a camera mostly sees does not count: it adds the same to all candidates.
    """
    clarity = np.array([each.clarity for each in candidates])
    seeing = np.nan_to_num(clarity).max(axis=0) > 0.0  # the others are covered, or have no images
    logs = np.log(np.maximum(clarity[:, seeing], np.finfo(np.float64).tiny))  # NaN stays
    scores: NDArray[np.float64] = np.where(np.isnan(logs), -np.inf, logs).sum(axis=1)
    return scores


def _places(candidates: Sequence[_Candidate]) -> Iterator[list[int]]:
    """Runs of candidates during which the vehicle stands."""
    place = [0]
    for (_, before), (number, candidate) in pairwise(enumerate(candidates)):
        if _stands(before, candidate):
            place.append(number)
        else:
            yield place
            place = [number]
    yield place


def _stands(before: _Candidate, candidate: _Candidate) -> bool:
    """Whether one camera has not moved between two candidates."""
    if before.view is None or candidate.view is None or before.view[0] != candidate.view[0]:
        return False
    return before.view[1].stands(candidate.view[1]) is True
