"""What matching and solving in rounds has produced: the input of the checks on images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from calibgraph.io.dataset import Dataset
from calibgraph.matching.protocol import FullMatcher
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Rig
from calibgraph.progress import Stopwatch
from calibgraph.solver.solution import Solution

RoundSummary = Mapping[str, Mapping[str, float]]
"""Per camera: ``matches``, and by how much the round moved it, ``moved_deg`` and ``moved_cm``."""


@dataclass(frozen=True, eq=False)
class Rematch:
    """Where matching ended from two starts, the second displaced from the end of the first.

    Attributes:
        first: the end of the rounds.
        again: the end of matching from the displaced start; None if it failed.
        failure: why it failed.
    """

    first: Rig
    again: Rig | None
    failure: str = ""


@dataclass(frozen=True, eq=False)
class MatchingRun:
    """The outcome of all rounds.

    Attributes:
        dataset: images and clouds.
        matcher: what found the correspondences.
        guess: the initial guess.
        correspondences: of the last round; of cameras that were taken from the displaced start,
            those of its last round.
        solution: of the joint solve of them.
        rounds: per round and camera, see ``RoundSummary``.
        watch: seconds per stage.
        missed_rounds: how many rounds there was no time for.
        out_of_time: whether the time limit has passed.
        rematch: from a displaced start; None if it was not tried.
    """

    dataset: Dataset
    matcher: FullMatcher
    guess: Rig
    correspondences: Correspondences
    solution: Solution
    rounds: tuple[RoundSummary, ...]
    watch: Stopwatch
    missed_rounds: int = 0
    out_of_time: bool = False
    rematch: Rematch | None = None
