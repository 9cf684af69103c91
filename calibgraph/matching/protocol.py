"""The matcher protocol: three members that every matcher has, and seven more that it may have.

`Matcher` is the interface of a custom matcher. The program works with `FullMatcher`, which has all
members; `to_full_matcher` adds defaults for missing ones. In calibration they are used in this
order:

1. `with_estimate`: the matcher for the parts of lens and clock that are estimated.
2. `most_frames`: the largest number of frames that is used.
3. `knows_motion`: whether frames may lack the motion that a clock is estimated by.
4. `locate`: from where the rounds begin, and with which round.
5. `match`: once per round, `rounds` at most; each is followed by a joint solve (`stage1`).
6. `tracking_rounds`: run again from a start displaced from the result.
7. `release`: no more rounds of this matcher follow, but one of another `with_estimate`, if any.
8. `image_checks_can_fail`: whether the checks on images may FAIL the result.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from calibgraph.io.dataset import Dataset
from calibgraph.model.config import LensPart, Stage1Source
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.findings import STAGE1, MatcherFindings
from calibgraph.model.rig import Rig
from calibgraph.progress import Progress


@dataclass(frozen=True, eq=False)
class Start:
    """Where a matcher's rounds begin."""

    rig: Rig
    first_round: int = 0
    findings: MatcherFindings = field(default_factory=MatcherFindings)


class Matcher(Protocol):
    """Finds correspondences: the required members of a matcher.

    The members of :class:`FullMatcher` are optional. A class attribute, an attribute or a property
    will do for each member but ``match``.
    """

    @property
    def rounds(self) -> int:
        """Number of rounds of matching, each from the estimate of the round before; at least 1."""
        ...

    @property
    def stage1(self) -> Stage1Source:
        """Source of Stage 1's per-camera estimates.

        ``pnp``: one pose per frame from the correspondences, then their median (paper, section
        3.3). ``rig``: the extrinsics that the round was matched from.
        """
        ...

    def match(
        self, dataset: Dataset, rig: Rig, *, round_index: int, progress: Progress
    ) -> Correspondences:
        """Find the correspondences of all cameras and frames.

        Args:
            dataset: images and clouds.
            rig: lenses, and the current estimate of the extrinsics.
            round_index: 0 .. rounds - 1.
            progress: called as the work goes on.

        Returns:
            One table. Its metadata may carry findings, which the verdict reads: the keys that
            :meth:`calibgraph.model.findings.MatcherFindings.to_metadata` returns.
        """
        ...


class FullMatcher(Matcher, Protocol):
    """A matcher with every member."""

    @property
    def most_frames(self) -> int | None:
        """Most frames of a dataset to use, chosen of more; None (default) for all."""
        ...

    @property
    def knows_motion(self) -> bool:
        """Whether its tables have the motion of the LiDAR, ``twist_per_s``; by default not."""
        ...

    @property
    def tracking_rounds(self) -> tuple[int, ...]:
        """Indices of the rounds to run from an estimate that is nearly right.

        They match the single frames of a drive, and a start displaced from a result, which tests
        whether the result is found again. Empty (default): single frames go through all rounds, and
        there is no displaced start.
        """
        ...

    @property
    def image_checks_can_fail(self) -> bool:
        """Whether the checks on images may FAIL a result; if not (default), they WARN at most.

        The image evidence is measured by the matcher ``structure``, from which another matcher may
        differ with good reason.
        """
        ...

    def with_estimate(self, parts: Sequence[LensPart]) -> "FullMatcher":
        """The matcher for solves that estimate these parts of lens and clock; itself by default.

        One that is not itself matches also after ``release`` of the other: it checks the time of
        the images, if it has ``tracking_rounds``.
        """
        ...

    def locate(
        self, dataset: Dataset, rig: Rig, *, out_of_time: Callable[[], bool], progress: Progress
    ) -> Start:
        """Find where the rounds begin; by default, at the initial guess."""
        ...

    def release(self) -> None:
        """Release memory that is kept between rounds; does nothing by default."""
        ...


class MatcherWithDefaults:
    """A matcher with defaults in place of the members that it lacks: the only place of defaults."""

    def __init__(self, matcher: Matcher) -> None:
        self._matcher = matcher
        self.rounds = matcher.rounds
        self.stage1: Stage1Source = matcher.stage1
        self.most_frames: int | None = getattr(matcher, "most_frames", None)
        self.knows_motion = bool(getattr(matcher, "knows_motion", False))
        self.tracking_rounds = tuple(getattr(matcher, "tracking_rounds", ()))
        self.image_checks_can_fail = bool(getattr(matcher, "image_checks_can_fail", False))
        self._locate = getattr(matcher, "locate", None)
        self._release = getattr(matcher, "release", None)

    def with_estimate(self, parts: Sequence[LensPart]) -> FullMatcher:
        """The matcher's own way, or the same matcher."""
        make = getattr(self._matcher, "with_estimate", None)
        made = self._matcher if make is None else make(parts)
        return self if made is self._matcher else MatcherWithDefaults(made)

    def locate(
        self, dataset: Dataset, rig: Rig, *, out_of_time: Callable[[], bool], progress: Progress
    ) -> Start:
        """The matcher's own start, or the initial guess."""
        if self._locate is None:
            return Start(rig)
        start: Start = self._locate(dataset, rig, out_of_time=out_of_time, progress=progress)
        return start

    def match(
        self, dataset: Dataset, rig: Rig, *, round_index: int, progress: Progress
    ) -> Correspondences:
        """The matcher's own correspondences; its source of Stage 1 in their metadata."""
        table = self._matcher.match(dataset, rig, round_index=round_index, progress=progress)
        return table.with_metadata({STAGE1: self.stage1, **table.metadata})

    def release(self) -> None:
        """Release the memory that the matcher keeps between rounds."""
        if self._release is not None:
            self._release()


def to_full_matcher(matcher: Matcher) -> FullMatcher:
    """The matcher with every member.

    Raises:
        ValueError: if it has less than one round.
    """
    full = MatcherWithDefaults(matcher)
    if full.rounds < 1:
        raise ValueError(f"the matcher has {full.rounds} rounds, expected at least 1")
    return full
