"""The graph is Eq. 5 of the paper, evaluated here literally."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import logm

from calibgraph import Config, MatcherErrors, Rig, perturb, simulate_correspondences
from calibgraph.graph.objective import objective_graph
from calibgraph.model.config import TERMS
from calibgraph.model.correspondences import Correspondences
from calibgraph.solver.matches import camera_blocks
from calibgraph.solver.two_pass import optimize, to_values
from factors import ProjectionBlock

CONFIG = Config(prior_weight=2.0, relative_prior_weight=5.0, confidence_weights=True)
DELTA_PX = 4.0

Transforms = dict[str, np.ndarray]


def squared_log(T: np.ndarray) -> float:
    """|log(T)|^2 by the matrix logarithm: of the twist (omega, rho) in [[omega]x, rho; 0, 0]."""
    xi = np.real(logm(T))
    return float(np.sum([xi[2, 1] ** 2, xi[0, 2] ** 2, xi[1, 0] ** 2, *xi[:3, 3] ** 2]))


def reprojection(rig: Rig, table: Correspondences, T: Transforms) -> float:
    """sum_i sum_k rho(|w_ik (u_ik - pi_i(T_i, p_k))|^2), rho(s) = delta^2 log(1 + s / delta^2)."""
    total = 0.0
    for name, camera in rig.cameras.items():
        rows = table.of_camera(name)
        k = camera.intrinsics_px
        for u, p, c in zip(rows.pixels_px, rows.points_lidar_m, rows.confidence, strict=True):
            x, y, z = (T[name] @ [*p, 1.0])[:3]
            w = float(np.sqrt(np.clip(c, 0.1, 1.0)))  # in the confidence's single precision
            residual = w * (u - [k.fx * x / z + k.cx, k.fy * y / z + k.cy])
            s = residual @ residual
            total += DELTA_PX**2 * np.log1p(s / DELTA_PX**2)
    return float(total)


def priors(T_hat: Transforms, T: Transforms) -> float:
    """lambda sum_i |log(T_hat_i^-1 T_i)|^2."""
    return 2.0 * sum(squared_log(np.linalg.inv(T_hat[name]) @ T[name]) for name in T)


def relative_priors(T_hat: Transforms, T: Transforms, pairs: list[tuple[str, str]]) -> float:
    """mu |log(T_hat_12^-1 T_2 T_1^-1)|^2 with T_hat_12 = T_hat_2 T_hat_1^-1."""
    total = 0.0
    for one, two in pairs:
        T_hat_12 = T_hat[two] @ np.linalg.inv(T_hat[one])
        total += squared_log(np.linalg.inv(T_hat_12) @ T[two] @ np.linalg.inv(T[one]))
    return 5.0 * total


@pytest.fixture
def triple(pair: Rig) -> Rig:
    """Three cameras, so that a spanning set of pairs is not all pairs."""
    moved = perturb(pair, rotation_deg=5, translation_m=0.3, seed=9).cameras["left"]
    return pair.model_copy(update={"cameras": {**pair.cameras, "third": moved}})


def blocks_of(rig: Rig, table: Correspondences) -> dict[str, ProjectionBlock]:
    blocks = camera_blocks(rig, table, CONFIG)
    return {name: block.block.rescale(scale=DELTA_PX) for name, block in blocks.items()}


@pytest.mark.parametrize("terms", TERMS)
def test_twice_the_error_of_the_graph_is_eq_5(triple: Rig, terms: str) -> None:
    errors = MatcherErrors(noise_px=1.0, outlier_share=0.2)
    table = simulate_correspondences(triple, frames=2, matches=30, errors=errors)
    T_hat, T = (
        perturb(triple, rotation_deg=2, translation_m=0.2, seed=seed).T_camera_lidar
        for seed in (1, 2)
    )
    names = list(triple.cameras)
    expected = 0.0
    if terms in ("full", "reprojection"):
        expected += reprojection(triple, table, T)
    if terms != "reprojection":
        expected += priors(T_hat, T) + relative_priors(T_hat, T, [*pairwise(names)])
    graph = objective_graph(triple, blocks_of(triple, table), T_hat, CONFIG, terms=terms)
    # 180 terms, and logm's own error of some 1e-13.
    assert 2 * graph.error(to_values(names, T)) == pytest.approx(expected, rel=1e-10)


def test_weights_of_zero_give_no_factor(pair: Rig) -> None:
    config = CONFIG.changed(prior_weight=0.0, relative_prior_weight=0.0)
    assert objective_graph(pair, {}, pair.T_camera_lidar, config, terms="full").size() == 0


def test_the_optimum_of_the_priors_is_stage_1(pair: Rig) -> None:
    graph = objective_graph(pair, {}, pair.T_camera_lidar, CONFIG, terms="priors")
    start = perturb(pair, rotation_deg=3, translation_m=0.3).T_camera_lidar
    optimum = optimize(graph, list(pair.cameras), start)
    assert optimum.converged
    for name, T in pair.T_camera_lidar.items():
        np.testing.assert_allclose(optimum.T_camera_lidar[name], T, rtol=0, atol=1e-8)
    assert optimum.cost == pytest.approx(0.0, abs=1e-12)
