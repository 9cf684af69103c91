"""Frames of a dataset, matched one by one from the present estimate."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from calibgraph.errors import CalibrationError, CorrespondenceError, MotionError
from calibgraph.io.dataset import Dataset
from calibgraph.io.frame import Frame
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
from calibgraph.tracking.frames import Item, StreamFrame, frames_of_table
from calibgraph.tracking.sums import MOST_PLACES
from calibgraph.tracking.tracker import IncrementalCalibrator

MOST_AGAIN = 200
"""Frames that a restart looks at again, at 0.1 s each, to find where the vehicle is."""


@dataclass(frozen=True, eq=False)
class DatasetDrive:
    """A dataset as a drive: its first frames as a batch, the others one by one.

    Attributes:
        dataset: its frames, in order of time.
        matcher: its rounds for tracking are run, see ``Matcher``.
        config: settings of the solves between its rounds.
    """

    dataset: Dataset
    matcher: FullMatcher
    config: Config

    @cached_property
    def start(self) -> Calibration:
        """The first frames calibrated as a batch: several give far more matches than one.

        Raises:
            CalibrationError: if that fails.
        """
        head = replace(self.dataset, frames=self._head)
        return calibrate(head, rig=head.rig, matcher=self.matcher, config=self.config)

    @property
    def _head(self) -> tuple[Frame, ...]:
        return self.dataset.frames[: self.config.tracking.start_frames]

    def items(self, tracker: IncrementalCalibrator) -> Iterator[Item]:
        """The frames that a tracker has not had, each with its place."""
        seed = self.config.seed
        finder = PlaceFinder(tracker.initial_rig, most_places=MOST_PLACES, seed=seed)
        return with_places(self._frames(tracker), self.dataset, finder, tracker.places)

    def _frames(self, tracker: IncrementalCalibrator) -> Iterator[Item]:
        head, taken = self._head, tracker.frame
        if taken is None or taken < head[-1].index:
            # Also after a crash among the first frames: they continue from the same batch.
            table = self.start.correspondences
            assert table is not None  # calibrate keeps those of its last round
            yield from frames_of_table(table)
        for frame in self.dataset.frames[len(head) :]:
            if taken is None or frame.index > taken:
                yield self._match(frame, tracker.rig)

    def _match(self, frame: Frame, rig: Rig) -> Item:
        """A frame's matches: coarse from the present estimate, then finer from the solved rig."""
        alone = replace(self.dataset, frames=(frame,))
        rounds = self.matcher.tracking_rounds or tuple(range(self.matcher.rounds))
        try:
            for index in rounds:
                table = self.matcher.match(alone, rig, round_index=index, progress=no_progress)
                table = with_motion(table, alone)
                if index != rounds[-1]:
                    rig = _refined(rig, table, self.config)
        except MotionError:  # slower frames look right, and are not
            raise
        except (CalibrationError, OSError) as error:
            return CalibrationError(f"frame {frame.name} ({frame.index}): {error}")
        return StreamFrame(frame.index, table)


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
    for item in items:
        if isinstance(item, CalibrationError) or not item.table.findings.place_variance:
            yield item
            continue
        if first:
            for number in first:
                finder.remember(frames[number])
            for number in [n for n in frames if max(first) <= n < item.frame][-MOST_AGAIN:]:
                finder.first_of_place(frames[number])
            first = []
        place = finder.first_of_place(frames[item.frame])
        yield replace(item, place=str(place))


def _refined(rig: Rig, table: Correspondences, config: Config) -> Rig:
    """The rig with each camera solved from one frame, where it has enough matches."""
    for name in table.cameras:
        one, own = Rig(cameras={name: rig.cameras[name]}), table.of_camera(name)
        try:
            rig = rig.moved_to(solve_joint(one, own, config).T_camera_lidar)
        except CorrespondenceError:  # too few matches: the next round starts from the same rig
            continue
    return rig
