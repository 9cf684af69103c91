"""Correlation windows: both classes agree, with the plainest way too."""

from __future__ import annotations

import torch

from calibgraph.matching.cmrnext.correlation import OnTheFly, Volume, cross_entropy
from tests.matching.cmrnext import reference_network


def test_volume_and_on_the_fly_agree() -> None:
    generator = torch.Generator().manual_seed(1)
    lidar, image = (torch.randn(2, 32, 16, 24, generator=generator) for _ in range(2))
    spread = torch.rand(2, 2, 16, 24, generator=generator) * 60 - 20  # inside, across the edge, out
    one, two = Volume(lidar, image).window(spread), OnTheFly(lidar, image).window(spread)
    torch.testing.assert_close(one, two, atol=1e-5, rtol=0)
    torch.testing.assert_close(
        one, reference_network.lookup(lidar, image, spread), atol=1e-4, rtol=0
    )


def test_correlation_far_outside_is_zero() -> None:
    lidar = torch.ones(1, 8, 16, 16)
    for value in (1e30, -1e30, torch.nan, torch.inf):
        positions = torch.full((1, 2, 16, 16), value)
        for way in (Volume, OnTheFly):
            assert not way(lidar, lidar).window(positions).any()


def test_cross_entropy_is_least_at_the_right_target() -> None:
    """Windows that are certain of one whole cell, and of the middle between two."""
    windows = torch.full((2, 81), -50.0)
    windows[0, 9 * (3 + 4) + (-2 + 4)] = 50.0  # x = 3, y = -2
    windows[1, 9 * (0 + 4) + (1 + 4)] = windows[1, 9 * (1 + 4) + (1 + 4)] = 50.0
    targets = torch.tensor([[3.0, -2.0], [0.5, 1.0]])
    assert cross_entropy(windows[:1], targets[:1]) < 1e-3
    torch.testing.assert_close(cross_entropy(windows[1:], targets[1:]), torch.tensor(2.0).log())
    assert cross_entropy(windows, targets.flip(1)) > 10
