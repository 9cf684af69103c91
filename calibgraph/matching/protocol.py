"""The matcher protocol: three members that every matcher has, and seven more that it may have.

`Matcher` is the interface of a custom matcher. The program works with `FullMatcher`, which has all
members, with defaults for missing ones; ``docs/matchers.md`` has them in a table.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from calibgraph.io.dataset import Dataset
from calibgraph.matching.joined_clouds import with_lidar_errors
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


class FullMatcher:
    """A matcher with every member: the only place of the defaults.

    Attributes:
        inner: the matcher itself.
        rounds, stage1: as of :class:`Matcher`.
        most_frames: most frames of a dataset to use, chosen of more; None for all.
        knows_motion: whether its tables have the motion of the LiDAR, ``twist_per_s``.
        tracking_rounds: indices of the rounds to run from an estimate that is nearly right: for the
            single frames of a drive, and from a start displaced from a result, which tests whether
            the result is found again. If empty, single frames go through all rounds, and there is
            no displaced start.
        image_checks_can_fail: whether the checks on images may FAIL a result, or WARN at most: the
            image evidence is measured by the matcher ``structure``, from which another matcher may
            differ with good reason.

    Raises:
        ValueError: if the matcher has less than one round.
    """

    def __init__(self, matcher: Matcher) -> None:
        if matcher.rounds < 1:
            raise ValueError(f"the matcher has {matcher.rounds} rounds, expected at least 1")
        self.inner = matcher
        self.rounds = matcher.rounds
        self.stage1: Stage1Source = matcher.stage1
        self.most_frames: int | None = getattr(matcher, "most_frames", None)
        self.knows_motion = bool(getattr(matcher, "knows_motion", False))
        self.tracking_rounds = tuple(getattr(matcher, "tracking_rounds", ()))
        self.image_checks_can_fail = bool(getattr(matcher, "image_checks_can_fail", False))

    def with_estimate(self, parts: Sequence[LensPart]) -> "FullMatcher":
        """The matcher for solves that estimate these parts of lens and clock; itself by default.

        One that is not itself matches also after ``release`` of the other: it checks the time of
        the images, if it has ``tracking_rounds``.
        """
        make = getattr(self.inner, "with_estimate", None)
        made = self.inner if make is None else make(parts)
        return self if made is self.inner else FullMatcher(made)

    def locate(
        self, dataset: Dataset, rig: Rig, *, out_of_time: Callable[[], bool], progress: Progress
    ) -> Start:
        """Find where the rounds begin; by default, at the initial guess."""
        locate = getattr(self.inner, "locate", None)
        if locate is None:
            return Start(rig)
        start: Start = locate(dataset, rig, out_of_time=out_of_time, progress=progress)
        return start

    def match(
        self, dataset: Dataset, rig: Rig, *, round_index: int, progress: Progress
    ) -> Correspondences:
        """The matcher's own correspondences; its source of Stage 1 in their metadata.

        With joined clouds they state what errors of LiDARs add, too.
        """
        table = self.inner.match(dataset, rig, round_index=round_index, progress=progress)
        table = table.with_metadata({STAGE1: self.stage1, **table.metadata})
        return with_lidar_errors(table, dataset, rig)

    def release(self) -> None:
        """No more rounds follow: release memory that is kept between them; nothing by default."""
        getattr(self.inner, "release", lambda: None)()
