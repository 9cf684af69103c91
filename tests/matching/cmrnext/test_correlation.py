"""Correlation windows: both classes agree, with the plainest way too."""

from __future__ import annotations

import torch

from calibgraph.matching.cmrnext.correlation import OnTheFly, Volume
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
