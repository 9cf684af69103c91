"""Videos of a camera beside the clouds: a picture is read by an address, as a file is."""

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import FileError, needs_extra
from calibgraph.files import read_text

VIDEO_SUFFIXES = (".mp4", ".mkv", ".avi", ".mov")
PICTURE_SUFFIX = ".picture"
STAMPS_SUFFIX = ".txt"

_KEPT = 16  # videos whose times are held


def pictures_of_video(video: Path, stems: Sequence[str]) -> dict[str, Path]:
    """The addresses of the pictures that belong to clouds, by the clouds' stems.

    Beside ``front.mp4``, ``front.txt`` has a line per picture with its stamp, in the unit of the
    clouds' stems; a cloud belongs to the nearest picture, not more than half a picture's time
    apart. Without that file there are as many pictures as clouds, in the same order.

    Raises:
        FileError: if the video cannot be read, its pictures are not as many as its stamps or the
            clouds, or a stamp or stem is no number.
    """
    count = len(_times(video))
    stamps = video.with_suffix(STAMPS_SUFFIX)
    if stamps.is_file():
        found = _nearest(video, _stamps(stamps, count), stems)
    elif count == len(stems):
        found = dict(zip(stems, range(count), strict=True))
    else:
        raise FileError(
            video,
            f"has {count} pictures beside {len(stems)} clouds; write the stamp of each picture "
            f"into {stamps.name}, a line each, in the unit of the clouds' names",
        )
    return {stem: video / f"{number:06}{PICTURE_SUFFIX}" for stem, number in found.items()}


def load_picture(address: Path) -> NDArray[np.uint8]:
    """(height, width, 3) the picture with this address, BGR."""
    video, number = address.parent, int(address.stem)
    times = _times(video)
    if number >= len(times):
        raise FileError(video, f"has {len(times)} pictures, no number {number}")
    with _opened(video) as container:
        stream = container.streams.video[0]
        container.seek(times[number], stream=stream, backward=True)
        for picture in container.decode(stream):
            if picture.pts == times[number]:
                _require_upright(video, picture)
                return np.ascontiguousarray(picture.to_ndarray(format="bgr24"), np.uint8)
    raise FileError(video, f"is damaged: its picture {number} cannot be decoded; copy it again")


def hash_picture(address: Path) -> str:
    """SHA-256 of the pixels of the picture with this address."""
    return hashlib.sha256(load_picture(address).tobytes()).hexdigest()


def _times(video: Path) -> tuple[int, ...]:
    """When each picture is shown, in the video's unit, in order; nothing is decoded."""
    if not video.is_file():
        raise FileError(video, "no such video")
    return _read_times(video, video.stat().st_mtime_ns)


@lru_cache(_KEPT)
def _read_times(video: Path, _changed_ns: int) -> tuple[int, ...]:
    with _opened(video) as container:
        if not container.streams.video:
            raise FileError(video, "holds no video")
        packets = container.demux(container.streams.video[0])
        times = [p.pts for p in packets if p.pts is not None and not p.is_discard]
    if len(set(times)) < max(1, len(times)):
        raise FileError(video, "has pictures without a time of their own; write it anew")
    return tuple(sorted(times))


@contextmanager
def _opened(video: Path) -> Iterator[Any]:
    with needs_extra("video", f"{video}: reading videos needs PyAV"):
        import av
    try:
        with av.open(str(video)) as container:
            yield container
    except (av.FFmpegError, ValueError) as error:
        raise FileError(video, f"cannot be read as a video ({error}); copy it again") from error


def _require_upright(video: Path, picture: Any) -> None:
    """Refuse a turn: it is unknown which pixels the intrinsics count, turned or stored."""
    if picture.rotation:
        raise FileError(
            video,
            f"is to be shown turned by {picture.rotation} deg, which some programs do and others "
            "do not; write it without, and the intrinsics for the pixels as they are stored",
        )


def _stamps(path: Path, count: int) -> NDArray[np.float64]:
    lines = read_text(path).split()
    if len(lines) != count:
        raise FileError(path, f"has {len(lines)} stamps, the video {count} pictures")
    stamps = _numbers(path, lines)
    if (np.diff(stamps) <= 0).any():
        raise FileError(path, "its stamps do not increase")
    return stamps


def _nearest(video: Path, stamps: NDArray[np.float64], stems: Sequence[str]) -> dict[str, int]:
    """The picture nearest to each cloud that has one near enough."""
    clouds = _numbers(video.parent, stems)
    period = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    after = np.searchsorted(stamps, clouds).clip(0, len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(clouds - stamps[before] < stamps[after] - clouds, before, after)
    near = np.abs(stamps[nearest] - clouds) <= period / 2
    return {stem: int(n) for stem, n, fits in zip(stems, nearest, near, strict=True) if fits}


def _numbers(where: Path, texts: Sequence[str]) -> NDArray[np.float64]:
    try:
        numbers = np.array(texts, dtype=np.float64)
    except ValueError as error:
        raise FileError(where, f"expected stamps that are numbers ({error})") from error
    if not np.isfinite(numbers).all():
        raise FileError(where, "expected stamps that are finite")
    return numbers
