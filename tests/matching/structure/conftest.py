from __future__ import annotations

import pytest

import calibgraph
from calibgraph import Rig
from tests.conftest import SAMPLE


@pytest.fixture(scope="package")
def truth() -> Rig:
    """The sample's rig at its true poses."""
    return calibgraph.load_rig(SAMPLE / "reference.yaml")
