"""Settings and presets."""

from __future__ import annotations

from calibgraph import (
    Rig,
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
