from __future__ import annotations

import numpy as np

from calibgraph import Config, Rig, solve
from calibgraph.trust.observability import weakest_direction
from tests.trust.conftest import named, simulated


def test_the_weakest_direction_is_named() -> None:
    sigmas = np.array([1e-4, 1e-4, 1e-4, 0.001, 0.001, 0.038])
    assert weakest_direction(np.diag(sigmas**2)) == (
        "shift along z (the optical axis) 3.8 cm (1 sigma)"
    )


def test_empty_parts_of_image_and_depth_are_named(pair: Rig) -> None:
    table = simulated(pair, depth_m=(9.0, 14.0))
    right = table.select(table.pixels_px[:, 0] > 500)
    words = "; ".join(solve(pair, right).weaknesses["left"])
    assert "the left third of the image has no matches" in words
    assert "nothing nearer than 9" in words and "nothing farther than 14 m" in words
    assert "middle third" not in words and "hard to distinguish" in words


def test_the_share_of_the_priors_is_their_influence(pair: Rig) -> None:
    table = simulated(pair)
    assert solve(pair, table, terms="reprojection").prior_share["left"] == 0
    strong = solve(pair, table, Config(prior_weight=1e12))
    assert strong.prior_share["left"] > 0.99
    assert named(strong, "left", "share of the priors")[0].status == "WARN"
