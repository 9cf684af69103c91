"""The frames of a bag: each cloud with the image of every camera that is nearest by stamp."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import DatasetError
from calibgraph.io.bags.messages import Bag
from calibgraph.io.bags.options import BagOptions, Motion
from calibgraph.io.bags.point_clouds import time_fields
from calibgraph.io.bags.stamps import (
    TopicStamps,
    describe_offsets,
    nearest,
    offsets_of,
    read_stamps,
    to_every_ns,
    windows_of,
)
from calibgraph.io.bags.topics import RigTopics, choose_topics

_S = 1_000_000_000
Rows = NDArray[np.int64]


@dataclass(frozen=True)
class BagFrame:
    """A cloud and an image of every camera.

    Attributes:
        number: counts the clouds that were read, and goes on by one more wherever others were not:
            the frames before and after in the recording have the numbers before and after.
        cloud: its address.
        images: the address of each camera's image.
        to_s: the median stamp of the images, in seconds after the cloud's.
    """

    number: int
    stamp_ns: int
    cloud: Path
    images: dict[str, Path]
    to_s: float


@dataclass(frozen=True)
class BagFrames:
    """The frames of a bag.

    Attributes:
        recorded: all that were read and are complete, in the order of recording.
        picked: positions of those that ``every_s`` picks; of all without it.
        summary: in one line, how many there are, how far apart their stamps are, and how many
            messages were left out, and why.
    """

    recorded: tuple[BagFrame, ...]
    picked: tuple[int, ...]
    summary: str


def frames_of_bag(path: Path, cameras: Sequence[str], options: BagOptions) -> BagFrames:
    """Pair the clouds of a bag with its images, without keeping any of them."""
    bag = Bag(path)
    topics = choose_topics(bag, options.topics, cameras)
    images = {name: each.image for name, each in topics.cameras.items()}
    read = [topics.lidar, *images.values()]
    windows = windows_of(bag, read, options.every_s)
    stamps = read_stamps(bag, read, windows, options.stamps)
    clouds = stamps[topics.lidar]
    tolerance_ns = round(options.tolerance_s * _S)
    pairs = {n: nearest(clouds, stamps[topic], tolerance_ns) for n, topic in images.items()}
    complete = np.flatnonzero(np.all([rows >= 0 for rows in pairs.values()], axis=0))
    summary = _summary(stamps, topics, pairs, complete, options=options)
    if not len(complete):
        raise DatasetError(f"{path}: {summary}; {_advice(stamps, topics, pairs)}")
    record_ns = np.array(clouds.record_ns)[complete]
    cells = _cells(record_ns, bag.start_ns, options.every_s)
    recorded = tuple(
        BagFrame(
            number=int(row + cell),
            stamp_ns=clouds.stamp_ns[row],
            cloud=clouds.paths[row],
            images={n: stamps[images[n]].paths[rows[row]] for n, rows in pairs.items()},
            to_s=float(
                np.median(
                    [
                        stamps[images[n]].stamp_ns[rows[row]] - clouds.stamp_ns[row]
                        for n, rows in pairs.items()
                    ]
                )
            )
            / _S,
        )
        for row, cell in zip(complete, cells, strict=True)
    )
    picked = _picked(record_ns, cells, windows) if options.every_s else range(len(recorded))
    return BagFrames(recorded, tuple(picked), summary + _note(bag, topics.lidar, options.motion))


def _note(bag: Bag, topic: str, motion: Motion) -> str:
    """How clouds are corrected for motion, or what to do if points have times."""
    times = time_fields(bag.first(topic))
    if motion != "none":
        of = times[0] if times else "stamp of the cloud, as points have no times"
        return f"; clouds are corrected for motion by {motion}, with the {of}"
    if not times:
        return ""
    return (
        f"; points have a {times[0]}: unless they are corrected for motion, give --motion "
        "odometry, tf or scans, or stand still"
    )


def _cells(record_ns: Rows, start_ns: int, every_s: float | None) -> Rows:
    """(n,) in which ``every_s`` of the bag each message was recorded; 0 without it."""
    if every_s is None:
        return np.zeros_like(record_ns)
    return (record_ns - start_ns) // to_every_ns(every_s)


def _picked(record_ns: Rows, cells: Rows, windows: Sequence[tuple[int, int]]) -> tuple[int, ...]:
    """Positions of the frames nearest to the middles of their windows: they have neighbours."""
    middles = np.array([(start + stop) // 2 for start, stop in windows])
    apart = np.abs(record_ns - middles[cells])
    return tuple(
        int(rows[np.argmin(apart[rows])])
        for rows in (np.flatnonzero(cells == cell) for cell in np.unique(cells))
    )


def _summary(
    stamps: Mapping[str, TopicStamps],
    topics: RigTopics,
    pairs: Mapping[str, Rows],
    complete: Rows,
    *,
    options: BagOptions,
) -> str:
    """How many frames there are, how far apart their stamps are, and what was left out."""
    clouds = stamps[topics.lidar]
    parts = [
        f"{len(clouds.paths)} clouds, {len(complete)} with all images within "
        f"{options.tolerance_s:g} s"
    ]
    for name, rows in pairs.items():
        images = stamps[topics.cameras[name].image]
        if len(complete):
            ahead = np.array(images.stamp_ns)[rows] - np.array(clouds.stamp_ns)
            ahead_ms = ahead[complete] / 1e6
            most = np.abs(ahead_ms).max()
            parts.append(f"{name} {np.median(ahead_ms):+.0f} ms (median), at most {most:.0f}")
        if np.any(rows < 0):
            parts.append(f"{np.sum(rows < 0)} without an image of {name}")
    for topic, each in stamps.items():
        counted = (
            (each.repeated, "repeat a stamp"),
            (each.empty, "have no point"),
            (each.back, "have a stamp before the last"),
        )
        parts += [f"{topic}: {count} {what}" for count, what in counted if count]
    return "; ".join(parts)


def _advice(stamps: Mapping[str, TopicStamps], topics: RigTopics, pairs: Mapping[str, Rows]) -> str:
    """What to do if no frame is complete."""
    for topic in stamps:
        if not stamps[topic].paths:
            return f"{topic} has nothing to use; choose another topic"
    worst = min(pairs, key=lambda name: int(np.sum(pairs[name] >= 0)))
    apart = offsets_of(stamps[topics.lidar], stamps[topics.cameras[worst].image])
    if len(apart):
        return (
            f"the nearest images of {describe_offsets(worst, apart)}; give --stamps record if the "
            "clocks differ, or a larger --tolerance-s if that is acceptable"
        )
    spans = [
        f"{topic} {stamps[topic].stamp_ns[0] / _S:.3f} to {stamps[topic].stamp_ns[-1] / _S:.3f} s"
        for topic in (topics.lidar, topics.cameras[worst].image)
    ]
    return (
        f"the stamps of {' and of '.join(spans)} do not meet; give --stamps record if the clocks "
        "differ, or a larger --tolerance-s"
    )
