from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from calibgraph.fleet.model import FleetModel, fit_fleet
from calibgraph.fleet.observations import observe
from tests.draws.fleets import Fleet, simulate_fleet


@dataclass(frozen=True)
class Fitted:
    truth: Fleet
    model: FleetModel


@pytest.fixture(scope="session")
def fitted() -> Fitted:
    """500 vehicles, 5 % of cameras moved, one batch changed, one changed later, one drift."""
    rng = np.random.default_rng(0)
    truth = simulate_fleet(rng, 500, mileage_deg=0.15, step_deg=0.5)
    return Fitted(truth, fit_fleet(observe(truth.rows)))
