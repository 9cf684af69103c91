"""Settings and presets."""

from __future__ import annotations

from pathlib import Path

import pytest

from calibgraph import (
    FileError,
    Rig,
    load_config,
    preset,
)


def test_presets_use_the_papers_numbers(pair: Rig) -> None:
    kitti, walkley = preset("kitti"), preset("walkley")
    assert (kitti.prior_weight, kitti.relative_prior_weight) == (1, 5)
    assert (kitti.loss_scale_px, kitti.gate_px, kitti.confidence_min) == (4, 3, 0.1)
    assert (walkley.prior_weight, walkley.relative_prior_weight) == (2, 10)
    assert (walkley.loss_scale_px, walkley.gate_px, walkley.confidence_min) == (8, 16, 0.2)
    assert walkley.confidence_weights
    assert not kitti.confidence_weights


def test_a_bootstrap_of_one_draw_is_refused_because_it_has_no_scatter(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("bootstrap: 1\n")
    with pytest.raises(FileError, match="bootstrap: one draw has no scatter; give 0 for none"):
        load_config(path)
    for draws in (0, 2):
        path.write_text(f"bootstrap: {draws}\n")
        assert load_config(path).bootstrap == draws
