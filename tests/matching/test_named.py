from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import calibgraph
from calibgraph import Correspondences, Rig
from calibgraph.matching.named import find_matcher
from calibgraph.progress import no_progress
from tests.conftest import SAMPLE


@pytest.fixture(scope="module")
def truth() -> Rig:
    return calibgraph.load_rig(SAMPLE / "reference.yaml")


@pytest.fixture(scope="module")
def table(truth: Rig) -> Correspondences:
    return calibgraph.simulate_correspondences(truth, frames=4, matches=20)


@pytest.mark.parametrize("source", ["memory", ".parquet", ".csv"])
def test_a_table_matches_the_frames_of_the_dataset(
    table: Correspondences, truth: Rig, tmp_path: Path, source: str
) -> None:
    path = tmp_path / f"table{source}"
    if source != "memory":
        table.save(path)
    matcher = find_matcher(table if source == "memory" else path)
    data = calibgraph.load_dataset(SAMPLE, truth).select("1:3")
    rows = matcher.match(data, truth, round_index=0, progress=no_progress)
    assert set(np.unique(rows.frame)) == {1, 2}
    assert len(rows) == np.count_nonzero(np.isin(table.frame, (1, 2)))
    assert (matcher.rounds, matcher.stage1, matcher.tracking_rounds) == (1, "pnp", ())


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("cmrnext", "the matcher 'cmrnext' needs weights"),
        ("sift", "unknown matcher 'sift'; known are 'structure', 'cmrnext' and a table"),
    ],
)
def test_other_names_are_errors(name: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        find_matcher(name)
