"""How much a window tells where it is."""

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from calibgraph.matching.structure.score_kernel import pad, score_windows
from calibgraph.matching.structure.window_weights import FEATURES, WindowNetwork, window_network
from calibgraph.matching.structure.windows import (
    WINDOW,
    WINDOW_POINTS,
    Windows,
    describe_windows,
    weigh,
)

Array = NDArray[np.float64]

STEP = np.radians(0.2)
ALL = np.ones((1, WINDOW_POINTS), np.bool_)
MEMBERS = np.arange(WINDOW_POINTS, dtype=np.int32)[None]


def grid_of_rays() -> Array:
    """(25, 3) unit vectors about the x axis, five by five, the middle one first."""
    angles = STEP * np.arange(-2, 3)
    cells = sorted(itertools.product(angles, angles), key=lambda cell: np.hypot(*cell))
    rays = np.array([[1.0, np.tan(a), np.tan(e)] for a, e in cells])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def features_of(ranges_m: Array, rank: Array, rays: Array | None = None) -> dict[str, float]:
    rays = (grid_of_rays() if rays is None else rays) * ranges_m[:, None]
    windows, _ = describe_windows((rays, rank), MEMBERS, ALL, keep_linear=True)
    return dict(zip(FEATURES, windows["features"][0].tolist(), strict=True))


def test_a_wall_is_a_plane_and_an_edge_is_two_classes() -> None:
    rays, flat = grid_of_rays(), np.full(WINDOW_POINTS, 0.5)
    wall = features_of(10.0 / rays[:, 0], np.linspace(0, 1, WINDOW_POINTS))
    edge = features_of(np.where(rays[:, 1] > 0, 10.0, 20.0), flat)
    noise = np.random.default_rng(0).uniform(5, 20, WINDOW_POINTS)
    leaves = features_of(noise, flat)
    # A plane's inverse range is linear in direction, to the second order of 0.4 degrees.
    slanted = features_of(10.0 / (rays @ [0.5, 0.5, 0.0]), flat)
    assert slanted["depth beside a plane"] < 1e-4
    assert wall["log range"] == pytest.approx(np.log(10), abs=1e-4)
    assert edge["depth in two classes"] == pytest.approx(1.0)
    assert 0.2 < edge["depth beside a plane"] < 0.5  # a step of 5: 1 - 18/25 of it, or 2/5
    assert leaves["depth in two classes"] < 0.9 and leaves["depth beside a plane"] > 0.5


def test_a_weight_lessens_the_share_that_a_window_explains() -> None:
    """A score s becomes -log(1 - w (1 - exp(-s)))."""
    rng = np.random.default_rng(2)
    image = rng.normal(0, 0.3, (40, 60)).astype(np.float32)
    places = np.stack(np.meshgrid(np.arange(20, 25), np.arange(15, 20)), axis=2)
    windows = np.zeros(1, WINDOW)
    windows["count"] = WINDOW_POINTS
    basis = np.linalg.qr(rng.normal(size=(WINDOW_POINTS, 3)) - [[1, 0, 0]])[0][:, 1:]
    basis -= basis.mean(axis=0)
    windows["basis"][0, :, :2] = np.linalg.qr(basis)[0]

    def scores(of: Windows) -> Array:
        grids = np.zeros((1, 9, 9), np.float32)
        group, first = np.zeros(1, np.int32), np.array([-4, -4])
        at = places.reshape(1, WINDOW_POINTS, 2).astype(np.int32)
        score_windows(pad(image), at, of["count"], of["basis"], group, first, True, grids)
        return grids[0].astype(float)

    always = np.zeros((len(FEATURES), 1)), np.array([np.log(0.3 / 0.7)])
    network = WindowNetwork(np.zeros(len(FEATURES)), np.ones(len(FEATURES)), (always,))
    whole, weighed = scores(windows), scores(weigh(windows, network))
    # Single precision, and a product of factors near 1: some 1e-6 of a logarithm.
    np.testing.assert_allclose(weighed, -np.log(1 - 0.3 * (1 - np.exp(-whole))), atol=1e-5)
    assert np.ptp(whole) > 0.1


def test_the_network_is_two_hidden_layers_with_the_gelu_of_torch() -> None:
    network = window_network()
    values = np.random.default_rng(3).normal(0, 2, (50, len(FEATURES)))
    found = network.weights(values * network.spread + network.mean)
    for matrix, bias in network.layers:
        x = values @ matrix + bias
        values = x * (1 + np.tanh(np.sqrt(2 / np.pi) * (x + 0.044715 * x**3))) / 2
    # Weights are kept in single precision.
    np.testing.assert_allclose(found, 1 / (1 + np.exp(-x[:, 0])), atol=1e-6)
    assert sum(matrix.size + bias.size for matrix, bias in network.layers) == 529
