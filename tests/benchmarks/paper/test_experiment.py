"""The paper's experiment: rows, intervals, seeds, failures, its report."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.paper.__main__ import main
from benchmarks.paper.draws import HEADLINE, METHODS, STAGE1, TRF_TERMS, Draw, Source, source_from
from benchmarks.paper.experiment import interval, run_experiment
from benchmarks.paper.output import PAIR, markdown, published, to_mapping
from calibgraph import preset

KITTI = preset("kitti")


@dataclass(frozen=True)
class Thinned(Source):
    """A scenario whose first camera has few matches per draw."""

    kept: int = 5

    def draw(self, frames: int, seed: int) -> Draw:
        draw = super().draw(frames, seed)
        first = draw.table.camera_index == 0
        few = ~first | (np.cumsum(first) <= self.kept)
        return replace(draw, table=draw.table.select(few))


def run_main(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> None:
    """As ``python -m benchmarks.paper`` with these arguments."""
    monkeypatch.setattr(sys, "argv", ["benchmarks.paper", *map(str, arguments)])
    main()


@pytest.mark.slow
def test_every_row_and_metric_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run_main(monkeypatch, "kitti", "--frames", 5, "--draws", 2, "--out", tmp_path)
    assert "5 frames, 2 draws" in capsys.readouterr().out
    content = json.loads((tmp_path / "paper.json").read_text())
    (block,) = content["blocks"]
    assert (block["frames"], block["draws"]) == (5, 2)
    assert list(block["rows"]) == list(METHODS)
    for row in block["rows"].values():
        assert row["failed"] == 0
        assert list(row["numbers"]) == ["image_2", "image_3", "image_2->image_3"]
        for camera in ("image_2", "image_3"):
            numbers = row["numbers"][camera]
            assert len(numbers) == 10  # E_t, E_R, six axes, reprojection, improvement
            assert np.isfinite([*numbers.values()]).all()
    stage1 = block["rows"][STAGE1]["numbers"]["image_2"]
    assert stage1["reprojection_improvement_px"] == [0.0, 0.0, 0.0]
    tables = (tmp_path / "paper.md").read_text()
    assert all(name in tables for name in METHODS)


def numbers_of(*, seed: int = 0, jobs: int = 1) -> dict[str, object]:
    """An experiment without the seconds that it took."""
    report = run_experiment(
        source_from("kitti"), frames=[1], draws=2, config=KITTI, seed=seed, jobs=jobs, trf=False
    )
    content = to_mapping(report)
    assert content.pop("seconds")
    return content


def test_the_same_seed_gives_the_same_numbers() -> None:
    assert numbers_of() == numbers_of()
    assert numbers_of(seed=1)["blocks"] != numbers_of()["blocks"]


def test_intervals_are_medians_and_quantiles() -> None:
    found = interval([5.0, 1.0, 3.0, 2.0, 4.0, np.nan])
    # Linear between order statistics: 5 % of the way along 1 .. 5 is 1.2.
    assert found == pytest.approx((1.2, 3.0, 4.8))
    assert np.isnan(interval([np.nan])).all()


def test_rows_that_fail_are_counted_and_marked() -> None:
    report = run_experiment(Thinned("kitti"), frames=[2], draws=1, config=KITTI)
    rows = report.blocks[0].rows
    assert all(rows[name].failed == 1 for name in (STAGE1, HEADLINE, *TRF_TERMS))
    assert "| failed |" in markdown(report)


def test_the_papers_numbers_are_those_of_its_tables() -> None:
    full = list(TRF_TERMS)[-1]
    assert published("kitti", full, 100, 0)["translation_error_cm"] == 0.89
    assert published("walkley", full, 100, 1)["translation_error_cm"] == 3.14
    assert published("kitti", full, 10, PAIR)["rotation_error_deg"] == 0.033
    assert published("kitti", full, 10, 1)["reprojection_px"] == 0.41
    assert published("surround", full, 10, 0) == published("kitti", HEADLINE, 10, 0) == {}
