"""Find the matcher that the user chose: by name, by a file of correspondences, or an object."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibgraph.io.dataset import Dataset
from calibgraph.io.tables import load_correspondences
from calibgraph.matching.protocol import FullMatcher, Matcher
from calibgraph.model.config import Stage1Source
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Rig
from calibgraph.progress import Progress

if TYPE_CHECKING:
    from calibgraph.matching.structure import StructureMatcher


class TableMatcher:
    """A matcher that returns correspondences found before: a table, from a file or in memory."""

    rounds = 1
    stage1: Stage1Source = "pnp"

    def __init__(self, table: Correspondences) -> None:
        self.table = table
        self.knows_motion = table.twist_per_s is not None

    def match(
        self, dataset: Dataset, rig: Rig, *, round_index: int, progress: Progress
    ) -> Correspondences:
        """Return the rows of the table that belong to the dataset's frames."""
        frames = np.array([frame.index for frame in dataset.frames])
        return self.table.select(np.isin(self.table.frame, frames))


def is_table(matcher: Matcher | Correspondences | Path | str) -> bool:
    """Whether it is a table, whose points stay where they are, whatever clouds are given."""
    if isinstance(matcher, (str, Path)):
        return Path(matcher).suffix in (".parquet", ".csv")
    inner = matcher.inner if isinstance(matcher, FullMatcher) else matcher
    return isinstance(inner, (Correspondences, TableMatcher))


def find_matcher(matcher: Matcher | Correspondences | Path | str, *, seed: int = 0) -> FullMatcher:
    """Find a matcher, and complete it with the defaults of the protocol.

    Raises:
        ValueError: if it is a name, but not of a matcher; or if the matcher has no round.
        FileError, CorrespondenceError: if it is a file, but not a table.
    """
    if isinstance(matcher, Correspondences):
        return FullMatcher(TableMatcher(matcher))
    if not isinstance(matcher, (str, Path)):
        return FullMatcher(matcher)
    if str(matcher) == "structure":
        return FullMatcher(structure_matcher(seed=seed))
    if is_table(matcher):
        return FullMatcher(TableMatcher(load_correspondences(matcher)))
    if str(matcher) == "cmrnext":
        raise ValueError(
            "the matcher 'cmrnext' needs weights: --weights iter1.tar --weights iter5.tar, or "
            "CmrNextMatcher([...]) of calibgraph.matching.cmrnext"
        )
    raise ValueError(
        f"unknown matcher {str(matcher)!r}; known are 'structure', 'cmrnext' and a table of "
        "correspondences (.parquet or .csv)"
    )


def structure_matcher(
    *, seed: int, all_frames: bool = False, **search: float | None
) -> StructureMatcher:
    """The matcher ``structure``.

    Args:
        seed: of everything random.
        all_frames: match all frames, as when the user has selected them.
        search: its search_deg and search_m; None for the default; both 0 for no search.
    """
    from calibgraph.matching.structure import StructureMatcher

    given: dict[str, Any] = {name: value for name, value in search.items() if value is not None}
    if given and not any(given.values()):
        given = dict.fromkeys(search)
    frames: dict[str, Any] = {"most_frames": None} if all_frames else {}
    return StructureMatcher(seed=seed, **given, **frames)
