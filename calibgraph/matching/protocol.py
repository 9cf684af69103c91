"""What a matcher is: three members that every matcher has, and four that it may have."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, Protocol

from calibgraph.io.dataset import Dataset
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.rig import Rig
from calibgraph.progress import Progress

Stage1Source = Literal["pnp", "rig"]


@dataclass(frozen=True, eq=False)
class Start:
    """Where a matcher's rounds begin.

    Attributes:
        rig: with the extrinsics to begin from.
        first_round: index of the first round.
        findings: of the search; they join those of every round.
    """

    rig: Rig
    first_round: int = 0
    findings: MatcherFindings = field(default_factory=MatcherFindings)


class Matcher(Protocol):
    """What finds correspondences: the least that a matcher of your own needs.

    The other members of :class:`FullMatcher` are optional. The metadata of the tables may carry the
    keys of :class:`calibgraph.model.findings.MatcherFindings`, which the verdict reads.

    Attributes:
        rounds: how many rounds of matching it wants, each from a better estimate.
        stage1: where Stage 1's per-camera estimates come from: ``pnp``, one pose per frame from the
            correspondences, then their median (paper, section 3.3); or ``rig``, the estimate that
            the round was matched from.
    """

    rounds: int
    stage1: Stage1Source

    def match(
        self, dataset: Dataset, rig: Rig, *, round_index: int, progress: Progress
    ) -> Correspondences:
        """Find the correspondences of all cameras and frames.

        Args:
            dataset: images and clouds.
            rig: lenses, and the current estimate of the extrinsics.
            round_index: 0 .. rounds - 1.
            progress: called as the work goes on.
        """
        ...


class FullMatcher(Matcher, Protocol):
    """A matcher with every member.

    Attributes:
        most_frames: how many frames it is given at most, evenly spread over the dataset; None for
            all.
        tracking_rounds: indices of the rounds to run near a good estimate: for single frames of a
            drive, and from a start displaced from the result, to see whether it comes back. Empty:
            single frames go through all rounds, and there is no displaced start.
        fails_on_images: whether image evidence, which the matcher ``structure`` measures, may FAIL
            its result; else it can only WARN.
    """

    most_frames: int | None
    tracking_rounds: tuple[int, ...]
    fails_on_images: bool

    def locate(
        self, dataset: Dataset, rig: Rig, *, out_of_time: Callable[[], bool], progress: Progress
    ) -> Start:
        """Find where the rounds begin.

        Args:
            dataset: images and clouds.
            rig: lenses, and the initial guess.
            out_of_time: returns whether to hurry.
            progress: called as the work goes on.
        """
        ...


class CompletedMatcher:
    """A matcher of the user's own with the members that it lacks: the defaults, in one place."""

    def __init__(self, matcher: Matcher) -> None:
        self._matcher = matcher
        self.rounds = matcher.rounds
        self.stage1: Stage1Source = matcher.stage1
        self.most_frames: int | None = getattr(matcher, "most_frames", None)
        self.tracking_rounds = tuple(getattr(matcher, "tracking_rounds", ()))
        self.fails_on_images = bool(getattr(matcher, "fails_on_images", False))
        self._locate = getattr(matcher, "locate", None)

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
        """The matcher's own correspondences."""
        return self._matcher.match(dataset, rig, round_index=round_index, progress=progress)


def completed(matcher: Matcher) -> FullMatcher:
    """The matcher with every member.

    Raises:
        ValueError: if it wants less than one round.
    """
    full = CompletedMatcher(matcher)
    if full.rounds < 1:
        raise ValueError(f"the matcher wants {full.rounds} rounds, expected at least 1")
    return full
