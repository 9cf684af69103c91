"""The random search for settings."""

from __future__ import annotations

from pathlib import Path

from calibgraph import load_config, preset
from calibgraph.evaluation.sources import source_from
from calibgraph.evaluation.tune import Candidates, tune


def test_tune_picks_the_better_settings_and_tests_them_on_other_draws(tmp_path: Path) -> None:
    # A third of Walkley's matches are outliers: a loss and a gate of 1000 px let them in.
    sets = Candidates((1.0,), (5.0,), (1000.0, 4.0), (1000.0,))
    tuned = tune(source_from("walkley"), base=preset("walkley"), frames=3, draws=2, candidates=sets)
    assert [row.config.loss_scale_px for row in tuned.tried] == [4.0, 1000.0]
    assert tuned.tried[0].tuning < tuned.tried[1].tuning
    assert tuned.best.test not in (None, tuned.best.tuning)
    tuned.save(tmp_path / "found.yaml")
    assert load_config(tmp_path / "found.yaml") == tuned.best.config


def test_candidates_are_drawn_once_each() -> None:
    sets = Candidates((0.0, 1.0), (0.0, 5.0), (2.0,), (3.0,))
    configs = sets.sample(preset("kitti"), 50, seed=0)
    assert len(configs) == 4
    assert len({(c.prior_weight, c.relative_prior_weight) for c in configs}) == 4
