"""The block factor with a free lens: by differences, by separate factors, by GTSAM's own."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from factors import FreeLens, FreeLensBlock, Lens, free_lens_factor
from factors.free_lens import COEFFICIENT_NUMBERS
from tests.factors.blocks import KEY, LENSES, TRUTH, K, at, poses, world
from tests.factors.test_block import together

KEY_CLOUD, KEY_LENS = 6, 8
SIGMAS = {"focal": 0.002, "aspect": 0.001, "centre_x": 2.0, "centre_y": 3.0}
FREE = [name for name in LENSES if name != "equirectangular"]


def free(name: str) -> FreeLens:
    """All parameters of a lens."""
    lens = LENSES[name]
    sigmas = SIGMAS | dict.fromkeys(COEFFICIENT_NUMBERS[lens.kind], 0.01)
    return FreeLens(lens, tuple(sigmas), tuple(sigmas.values()))


def with_lens(pose: gtsam.Pose3, values: np.ndarray) -> gtsam.Values:
    found = at(pose)
    found.insert(KEY_LENS, values)
    return found


@pytest.mark.parametrize("name", FREE)
def test_derivatives_are_those_of_differences(name: str) -> None:
    lens, rng = free(name), np.random.default_rng(1)
    block = FreeLensBlock(world(LENSES[name], 50), lens)
    values, pose, step = (
        rng.standard_normal(len(lens)),
        TRUTH.retract(rng.normal(size=6) / 50),
        1e-5,
    )
    T = pose.inverse().matrix()
    columns = block.columns(T, values)
    for number, direction in enumerate(np.eye(6 + len(lens))):
        up, down = (
            block.columns(
                pose.retract(sign * step * direction[:6]).inverse().matrix(),
                values + sign * step * direction[6:],
            )[-1]
            for sign in (1, -1)
        )
        # Differences of numbers of size 1e3 px are exact to 1e3 * 1e-16 / 1e-5; their second
        # order is 1e-10 of the largest column.
        limit = 1e-6 * max(1.0, np.abs(columns[number]).max())
        np.testing.assert_allclose(columns[number], (up - down) / (2 * step), atol=limit)


@pytest.mark.parametrize("name", FREE)
def test_with_the_lens_held_it_is_the_block_factor(name: str) -> None:
    block, lens = world(LENSES[name], 60), free(name)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(free_lens_factor([KEY, KEY_LENS], FreeLensBlock(block, lens)))
    for pose in poses()[:3]:
        values = with_lens(pose, np.zeros(len(lens)))
        np.testing.assert_allclose(graph.error(values), together(block).error(at(pose)), rtol=1e-9)
        hessian, gradient = together(block).linearize(at(pose)).hessian()
        found = graph.linearize(values).hessian()
        np.testing.assert_allclose(found[0][:6, :6], hessian, atol=1e-9 * np.abs(hessian).max())
        np.testing.assert_allclose(found[1][:6], gradient, atol=1e-9 * np.abs(gradient).max())


@pytest.mark.parametrize(
    ("stock", "calibration", "distortion", "parameters"),
    [
        (gtsam.GeneralSFMFactor2Cal3_S2, gtsam.Cal3_S2, (), ()),
        (
            gtsam.GeneralSFMFactor2Cal3DS2,
            gtsam.Cal3DS2,
            (-0.2, 0.05, 0.001, -0.002),
            ("k1", "k2", "p1", "p2"),
        ),
    ],
)
def test_equals_factors_of_gtsam(stock, calibration, distortion, parameters) -> None:  # type: ignore[no-untyped-def]
    """Their calibration is fx, fy, skew, cx, cy and the coefficients; ours scales fx and fy."""
    lens = Lens.pinhole(**K, distortion=distortion)
    names = ("focal", "aspect", "centre_x", "centre_y", *parameters)
    free_lens = FreeLens(lens, names, (1.0,) * len(names))
    block = replace(world(lens, 20), sqrt_information=None, loss="l2")
    ours, theirs = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
    ours.add(free_lens_factor([KEY, KEY_LENS], FreeLensBlock(block, free_lens)))
    values = at(TRUTH.retract(np.full(6, 0.01)))
    values.insert(KEY_LENS, calibration(K["fx"], K["fy"], 0.0, K["cx"], K["cy"], *distortion))
    for number, (point, pixel) in enumerate(
        zip(block.points_lidar_m, block.pixels_px, strict=True), start=100
    ):
        values.insert(number, point)
        theirs.add(stock(pixel, gtsam.noiseModel.Unit.Create(2), KEY, number, KEY_LENS))
    keys = gtsam.Ordering()
    for key in (KEY, KEY_LENS):
        keys.push_back(key)
    whole = gtsam.Ordering(keys)
    for number in range(100, 100 + len(block)):
        whole.push_back(number)
    size = 6 + 5 + len(parameters)
    hessian, gradient = (part[:size, ...] for part in theirs.linearize(values).hessian(whole))
    chain = np.zeros((size, 6 + len(names)))
    chain[:6, :6] = np.eye(6)
    chain[6, 6:8], chain[7, 6:8] = [K["fx"], K["fx"] / 2], [K["fy"], -K["fy"] / 2]
    chain[9:, 8:] = np.eye(2 + len(parameters))
    here = with_lens(values.atPose3(KEY), np.zeros(len(names)))
    found = ours.linearize(here).hessian(keys)
    np.testing.assert_allclose(2 * ours.error(here), 2 * theirs.error(values), rtol=1e-9)
    expected = chain.T @ hessian[:, :size] @ chain
    np.testing.assert_allclose(found[0], expected, atol=1e-9 * np.abs(expected).max())
    pulled = chain.T @ gradient
    np.testing.assert_allclose(found[1], pulled, atol=1e-9 * np.abs(pulled).max())


def test_a_displaced_cloud_is_a_displaced_camera() -> None:
    lens = free("radtan")
    factor = free_lens_factor(
        [KEY_CLOUD, KEY, KEY_LENS], FreeLensBlock(world(LENSES["radtan"], 40), lens)
    )
    values = with_lens(TRUTH, np.full(len(lens), 0.3))
    values.insert(KEY_CLOUD, gtsam.Pose3().retract(np.linspace(-0.02, 0.03, 6)))
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factor)
    linear = graph.linearize(values)
    step = 1e-6
    for key, size in ((KEY_CLOUD, 6), (KEY, 6), (KEY_LENS, len(lens))):
        slope = linear.gradientAtZero().at(key)
        for number in range(size):
            moved = step * np.eye(size)[number]
            up, down = (graph.error(displace(values, key, s * moved)) for s in (1, -1))
            np.testing.assert_allclose(
                slope[number], (up - down) / (2 * step), rtol=1e-4, atol=1e-2
            )


def displace(values: gtsam.Values, key: int, step: np.ndarray) -> gtsam.Values:
    moved = gtsam.Values(values)
    if key == KEY_LENS:
        moved.update(key, values.atVector(key) + step)
    else:
        moved.update(key, values.atPose3(key).retract(step))
    return moved


def test_refuses_parameters_that_a_lens_does_not_have() -> None:
    with pytest.raises(ValueError, match="no free k4"):
        FreeLens(LENSES["radtan"], ("k4",), (1.0,))
    with pytest.raises(ValueError, match="no free focal"):
        FreeLens(LENSES["equirectangular"], ("focal",), (1.0,))
