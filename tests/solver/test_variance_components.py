"""The sizes of the error's components, found again from many draws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibgraph import MatcherErrors, Rig, concatenate, simulate_correspondences
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.solver.error_model import ErrorFit, fit_errors
from calibgraph.solver.joint import solve_joint
from calibgraph.solver.variance_components import VarianceRatios
from tests.draws.places import displaced

EXACT = MatcherErrors(noise_px=0.3, outlier_share=0.0)
STATED = {"place_rotation_rad": 1e-3, "place_translation_m": 0.01, "camera_share": 0.0}
SIGMAS = np.repeat([1e-3, 0.01], 3)


def table_of(rig: Rig, places: int, size: float, seed: int) -> Correspondences:
    """The cloud is displaced at each place, by ``size`` times the variance that is stated."""
    rng, tables = np.random.default_rng(seed), []
    for place in range(places):
        cloud = np.sqrt(size) * SIGMAS * rng.standard_normal(6)
        there = displaced(rig, cloud, np.zeros((len(rig.cameras), 6)))
        table = simulate_correspondences(
            there, frames=2, matches=200, errors=EXACT, seed=int(rng.integers(2**31))
        )
        tables.append(replace(table, frame=table.frame + 2 * place))
    joined = concatenate(tables)
    names = [[2 * place, 2 * place + 1] for place in range(places)]
    return replace(joined, metadata={**joined.metadata, **STATED, "places": names})


def errors_of(rig: Rig, table: Correspondences) -> ErrorFit:
    solution = solve_joint(rig, table, Config(learnt_weights=False))
    found = solution.errors or fit_errors(solution.fitted, table.findings, table.places)
    assert found is not None
    return found


@pytest.mark.parametrize("size", [0.25, 2.0])
def test_the_size_of_places_is_found_from_many_of_them(pair: Rig, size: float) -> None:
    places = 20
    found = [errors_of(pair, table_of(pair, places, size, seed)).ratios.cloud for seed in range(4)]
    # 6 (places - 1) degrees of freedom a table; what is usual counts as 12 of size 1.
    free = 6 * (places - 1)
    expected = (12 + free * size) / (12 + free)
    spread = size * np.sqrt(2 / free / len(found))
    assert np.mean(found) == pytest.approx(expected, rel=0.15, abs=4 * spread)


def test_few_places_are_never_taken_for_better_than_usual(pair: Rig) -> None:
    assert errors_of(pair, table_of(pair, 4, 0.0, 0)).ratios == VarianceRatios()


def test_one_place_has_the_usual_size(pair: Rig) -> None:
    """Nothing is measured twice, so nothing is learnt, whatever the error."""
    assert errors_of(pair, table_of(pair, 1, 25.0, 0)).ratios == VarianceRatios()
