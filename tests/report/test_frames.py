"""The files of a result's frames, after the dataset has moved."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

import calibgraph
from calibgraph import Calibration
from calibgraph.errors import DatasetError
from calibgraph.report.frames import relocate_frames
from tests.conftest import SAMPLE


def test_a_dataset_that_has_moved_is_found(sample_result: Calibration, tmp_path: Path) -> None:
    moved = Path(shutil.copytree(SAMPLE, tmp_path / "moved"))
    dataset = calibgraph.load_dataset(moved)
    found = relocate_frames(sample_result, dataset)
    assert [frame["name"] for frame in found.frames] == [f["name"] for f in sample_result.frames]
    assert all(frame["cloud"].startswith(str(moved)) for frame in found.frames)
    assert relocate_frames(replace(sample_result, frames=()), dataset).frames == found.frames
    with pytest.raises(DatasetError, match="has no frame number 3 named '000003'"):
        relocate_frames(sample_result, dataset.select("0:3"))


def test_another_recording_with_the_same_names_is_refused(
    sample_result: Calibration, tmp_path: Path
) -> None:
    other = Path(shutil.copytree(SAMPLE, tmp_path / "other"))
    first, second = sorted((other / "cameras" / "left").iterdir())[:2]
    shutil.copy(second, first)
    with pytest.raises(DatasetError, match=f"{first}: is not what the result was made from"):
        relocate_frames(sample_result, calibgraph.load_dataset(other))
