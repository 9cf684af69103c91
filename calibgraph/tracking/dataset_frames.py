"""Frames of a dataset, matched one by one from the present estimate."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from calibgraph.errors import CalibrationError, CorrespondenceError
from calibgraph.io.dataset import Dataset
from calibgraph.matching.places import PlaceFinder
from calibgraph.matching.protocol import FullMatcher
from calibgraph.matching.run import with_motion
from calibgraph.model.calibration import Calibration
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Rig
from calibgraph.pipeline import calibrate
from calibgraph.progress import no_progress
from calibgraph.solver.joint import solve_joint
from calibgraph.tracking.frame_order import with_place
from calibgraph.tracking.streams import Item, Refused, StreamFrame

MOST_AGAIN = 200
"""Frames that a restart looks at again, at 0.1 s each, to find where the vehicle is."""


def first_frames(dataset: Dataset, matcher: FullMatcher, config: Config) -> Calibration:
    """The first frames calibrated as a batch: several frames give far more matches than one.

    Raises:
        CalibrationError: if that fails.
    """
    count = config.tracking.start_frames
    head = replace(dataset, frames=dataset.frames[:count])
    return calibrate(head, rig=dataset.rig, matcher=matcher, config=config)


def frames_of_batch(result: Calibration) -> Iterator[Item]:
    """The frames of a batch's matches, one by one."""
    table = result.correspondences
    assert table is not None  # calibrate keeps those of its last round
    for frame in np.unique(table.frame):
        yield _stream_frame(int(frame), table.select(table.frame == frame))


def matched_frames(
    dataset: Dataset, matcher: FullMatcher, config: Config, current_rig: Callable[[], Rig]
) -> Iterator[Item]:
    """Match each frame from the present estimate.

    Args:
        dataset: its frames, in order of time.
        matcher: its rounds for tracking are run, see ``Matcher``.
        config: settings of the solves between its rounds.
        current_rig: returns the rig with the present estimate; called before each frame.
    """
    for frame in dataset.frames:
        alone = replace(dataset, frames=(frame,))
        try:
            table = _matched(alone, matcher, config, current_rig())
        except (CalibrationError, OSError) as error:
            yield Refused(f"frame {frame.name} ({frame.index}): {error}")
        else:
            yield _stream_frame(frame.index, table)


def with_places(
    items: Iterable[Item], dataset: Dataset, finder: PlaceFinder, known: Sequence[str]
) -> Iterator[Item]:
    """The items with the place of each frame named, as its images and its cloud show it.

    Where the matcher's error has a part that frames of one place share.

    Args:
        items: frames, those of the dataset, in order.
        dataset: all its frames.
        finder: at the first estimate, which a restart also has.
        known: names of the places of before a restart, that of the last frame last. Their first
            frames are looked at again, and the frames since the newest of them, or the last
            MOST_AGAIN, so that a restart finds the same places.
    """
    frames = {frame.index: frame for frame in dataset.frames}
    first = [int(name) for name in known if name.isdigit() and int(name) in frames]
    again = bool(first)
    for item in items:
        if isinstance(item, Refused) or not item.table.findings.place_variance:
            yield item
            continue
        if again:
            for number in first:
                finder.remember(frames[number])
            for number in [n for n in frames if max(first) <= n < item.frame][-MOST_AGAIN:]:
                finder.first_of_place(frames[number])
            again = False
        place = finder.first_of_place(frames[item.frame])
        yield replace(item, table=with_place(item.table, place))


def _matched(alone: Dataset, matcher: FullMatcher, config: Config, rig: Rig) -> Correspondences:
    """One frame's matches: coarse from the estimate, then finer from the solved rig."""
    *coarse, last = tracking_rounds(matcher)
    settings = config.changed(stage1=matcher.stage1)
    for index in coarse:
        table = matcher.match(alone, rig, round_index=index, progress=no_progress)
        rig = _refined(rig, with_motion(table, alone), settings)
    table = matcher.match(alone, rig, round_index=last, progress=no_progress)
    return with_motion(table, alone)


def tracking_rounds(matcher: FullMatcher) -> tuple[int, ...]:
    """The matcher's rounds for a single frame: its own choice, or all."""
    return matcher.tracking_rounds or tuple(range(matcher.rounds))


def _refined(rig: Rig, table: Correspondences, config: Config) -> Rig:
    """The rig with each camera solved from one frame, where it has enough matches."""
    for name in table.cameras:
        own = table.of_camera(name)
        own = replace(own, cameras=(name,), camera_index=np.zeros_like(own.camera_index))
        one = Rig(cameras={name: rig.cameras[name]})
        try:
            rig = rig.moved_to(solve_joint(one, own, config).T_camera_lidar)
        except CorrespondenceError:  # too few matches: the next round starts from the same rig
            continue
    return rig


def _stream_frame(number: int, table: Correspondences) -> StreamFrame:
    stamp = None if table.stamp_ns is None or not len(table) else int(table.stamp_ns.max())
    return StreamFrame(number, stamp, table)
