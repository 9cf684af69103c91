"""A street, shared by the tests of places."""

from __future__ import annotations

import pytest

from calibgraph.simulation.recording import Drive, build_drive


@pytest.fixture(scope="session")
def drive() -> Drive:
    """Stops about 9 m apart."""
    return build_drive(frames=6, step_m=9.0, seed=12)
