"""Searches of LiDARs are short, but for whole calibrations."""

import pytest

from calibgraph.vehicle import start


@pytest.fixture
def few_placements(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """The right placement is among the first."""
    if request.node.get_closest_marker("slow") is None:
        monkeypatch.setattr(start, "_TRIED", 3)
