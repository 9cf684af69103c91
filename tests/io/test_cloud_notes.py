"""Notes about clouds that can be read, but are poor."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibgraph import load_dataset
from calibgraph.io.clouds import read_cloud_notes
from tests.io.written import CLOUD, pcd

SAMPLE = Path(__file__).parents[2] / "data" / "sample"


def test_a_cloud_without_intensity_is_noted_with_its_fields(tmp_path: Path) -> None:
    (tmp_path / "cloud.pcd").write_bytes(pcd().replace(b"z intensity", b"z height"))
    (note,) = read_cloud_notes(tmp_path / "cloud.pcd")
    assert "no intensity among its fields x y z height; the error bars become about twice" in note


def test_an_intensity_that_is_the_same_everywhere_is_noted(tmp_path: Path) -> None:
    np.save(tmp_path / "cloud.npy", np.column_stack([CLOUD[:, :3], np.full(500, 7)]))
    (note,) = read_cloud_notes(tmp_path / "cloud.npy")
    assert "the intensity is 7 at all points" in note


def test_a_good_and_an_unreadable_cloud_have_no_note(tmp_path: Path) -> None:
    (tmp_path / "cloud.pcd").write_bytes(pcd())
    assert read_cloud_notes(tmp_path / "cloud.pcd") == []
    assert read_cloud_notes(tmp_path / "missing.pcd") == []
    assert load_dataset(SAMPLE).notes == ()
