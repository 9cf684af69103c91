"""The matcher that the user chose: by name, by the file of its correspondences, or an object."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibgraph.io.correspondence_tables import load_correspondences
from calibgraph.io.dataset import Dataset
from calibgraph.matching.protocol import FullMatcher, Matcher, Stage1Source, completed
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Rig
from calibgraph.progress import Progress


class Precomputed:
    """A matcher that has already run: its table, from a file or in memory."""

    rounds = 1
    stage1: Stage1Source = "pnp"

    def __init__(self, table: Correspondences) -> None:
        self.table = table

    def match(
        self, dataset: Dataset, rig: Rig, *, round_index: int, progress: Progress
    ) -> Correspondences:
        """Return the rows of the table that belong to the dataset's frames."""
        frames = np.array([frame.index for frame in dataset.frames])
        return self.table.select(np.isin(self.table.frame, frames))


def find_matcher(matcher: Matcher | Correspondences | Path | str, *, seed: int = 0) -> FullMatcher:
    """A matcher with every member, from whatever the user gave.

    Args:
        matcher: ``structure``; a table of correspondences, or its file; a matcher.
        seed: for a matcher by name that draws random numbers.

    Raises:
        ValueError: if it is a name, but not of a matcher; or if the matcher wants no round.
        FileError, CorrespondenceError: if it is a file, but not a table.
    """
    if isinstance(matcher, Correspondences):
        return completed(Precomputed(matcher))
    if not isinstance(matcher, (str, Path)):
        return completed(matcher)
    if str(matcher) == "structure":
        from calibgraph.matching.structure import StructureMatcher

        return completed(StructureMatcher(seed=seed))
    if Path(matcher).suffix in (".parquet", ".csv"):
        return completed(Precomputed(load_correspondences(matcher)))
    if str(matcher) == "cmrnext":
        raise ValueError(
            "the matcher 'cmrnext' needs weights: --weights iter1.tar iter5.tar iter6.tar, or "
            "CmrNextMatcher([...]) of calibgraph.matching.cmrnext"
        )
    raise ValueError(
        f"unknown matcher {str(matcher)!r}; known are 'structure', 'cmrnext' and a table of "
        "correspondences (.parquet or .csv)"
    )
