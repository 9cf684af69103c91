"""Many draws: the reported covariance is the scatter of the result. Marked, run apart."""

from collections.abc import Callable
from typing import Literal

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

import calibgraph
from calibgraph import Config, Correspondences, MatcherErrors, Rig, simulate_correspondences
from calibgraph.graph.lens import LensVariable
from calibgraph.model.geometry import relative_covariance
from calibgraph.model.lens import LensSigmas
from calibgraph.solver.joint import solve_joint
from tests.draws.lenses import put_lens_error, with_fields, with_known_lenses
from tests.draws.places import draw_places
from tests.solver.test_clock import STRAIGHT, late
from tests.solver.test_lens import simulated, squared_errors

pytestmark = pytest.mark.statistics

DRAWS = 200


def error(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """xi in estimate = exp(xi) truth."""
    return gtsam.Pose3.Logmap(gtsam.Pose3(estimate @ np.linalg.inv(truth)))


@pytest.mark.parametrize("frames", [1, 2, 3, pytest.param(6, marks=pytest.mark.ci), 30])
def test_the_covariance_is_the_scatter_over_draws(pair: Rig, frames: int) -> None:
    """Errors shared by a frame: (J^T J)^-1 would be too small by far, clusters are not.

    With few frames the error bar rests on how matches of a frame are usually correlated (0.2 of
    their variance; here it is a half), and on the allowance for what few frames leave unsaid.
    """
    errors = MatcherErrors(noise_px=1.0, frame_noise_px=1.0, outlier_share=0.15)
    squares: dict[str, list[float]] = {"left": [], "right": [], "left->right": []}
    pair = with_known_lenses(pair)
    for seed in range(DRAWS):
        table = simulate_correspondences(pair, frames=frames, matches=100, errors=errors, seed=seed)
        solved = solve_joint(pair, table)  # without the checks, which take most of a solve's time
        found, true = solved.T_camera_lidar, pair.T_camera_lidar
        joint = solved.covariance
        T_right_left = found["right"] @ np.linalg.inv(found["left"])
        xi_pair = error(T_right_left, true["right"] @ np.linalg.inv(true["left"]))
        for name, xi, covariance in (
            ("left", error(found["left"], true["left"]), joint[:6, :6]),
            ("right", error(found["right"], true["right"]), joint[6:, 6:]),
            ("left->right", xi_pair, relative_covariance(joint, 0, 1, T_right_left)),
        ):
            squares[name].append(float(xi @ np.linalg.solve(covariance, xi)))
    for name, values in squares.items():
        inside = np.mean(np.array(values) < chi2.ppf(0.95, 6))
        if frames == 30:
            assert 0.7 < np.mean(values) / 6 < 1.4, name
            assert 0.9 <= inside <= 0.98, name
        elif frames < 5:
            assert 0.3 < np.mean(values) / 6 < 1.3, name
            assert inside >= 0.88, name
        else:
            assert 0.5 < np.mean(values) / 6 < 1.4, name
            assert inside >= 0.9, name


@pytest.mark.parametrize("places", [1, 5])
@pytest.mark.parametrize("of", ["alignment", "mount"])
def test_the_reported_covariance_covers_draws_of_data(
    places: int, of: Literal["alignment", "mount"]
) -> None:
    """Of the default preset and tables that state the errors which were drawn, all of them.

    It is wider than the scatter, since the sizes of what is shared are estimated and never taken
    for smaller than stated with fewer than five places: the mean NEES over 6 is 0.64 to 0.79. The
    share inside the 95 % region has a standard deviation of 0.015.
    """
    found: dict[str, list[float]] = {}
    for seed in range(DRAWS):
        drawn = draw_places(places, 100, np.random.default_rng([29, seed]))
        result = calibgraph.solve(
            with_known_lenses(drawn.rig), drawn.table, Config(learnt_weights=False, of=of)
        )
        truth = drawn.aligned if of == "alignment" else drawn.rig.T_camera_lidar
        for name, T in truth.items():
            covariance = result.covariance[name]
            xi = error(result.T_camera_lidar[name], T)
            found.setdefault(name, []).append(float(xi @ np.linalg.solve(covariance, xi)))
    for name, values in found.items():
        assert 0.5 < np.mean(values) / 6 < 1.0, name
        assert np.mean(np.array(values) < chi2.ppf(0.95, 6)) >= 0.93, name


Drawn = tuple[Rig, Correspondences, Rig, Config]
"""The rig that is given, its table, the true rig, and the settings."""


def of_lens(part: str, error: float) -> Callable[[int], Drawn]:
    """A lens that is wrong in one part, which is estimated."""

    def draw(seed: int) -> Drawn:
        truth, table = simulated(seed, frames=30, matches=100)
        return put_lens_error(truth, part, error), table, truth, Config(estimate=part)

    return draw


def of_clock(offset_s: float, readout_s: float) -> Callable[[int], Drawn]:
    """A clock that is estimated."""

    def draw(seed: int) -> Drawn:
        truth, table = late(offset_s, readout_s, seed)
        return truth, table, truth, Config(estimate="clock")

    return draw


def of_stated_clock(seed: int) -> Drawn:
    """An alignment with an offset of the clock of which the rig states the sigma."""
    sigma_s = 0.01
    offset_s = sigma_s * np.random.default_rng([seed, 1]).standard_normal()
    truth, table = late(offset_s, 0.0, seed, np.tile(STRAIGHT, (30, 1)))
    return with_fields(truth, time_offset_sigma_s=sigma_s), table, truth, Config()


def of_mount(seed: int) -> Drawn:
    """A mount, with the lenses of good calibrations."""
    truth, table = simulated(seed, frames=30, matches=100)
    rng, cameras = np.random.default_rng([seed, 1]), {}
    for name, camera in truth.cameras.items():
        sigmas = LensSigmas.calibrated(camera)
        lens = LensVariable.of(camera, ("focal", "centre", "distortion"), sigmas)
        cameras[name] = lens.put_into(camera, rng.standard_normal(len(lens.free)))
    return truth.model_copy(update={"cameras": cameras}), table, truth, Config(of="mount")


@pytest.mark.parametrize(
    ("draw", "draws", "independent"),
    [
        *(
            (of_lens(part, error), 40, 40)  # as if both cameras erred alike
            for part, error in (
                ("focal", 0.003), ("focal", 0.05), ("centre", 10.0), ("distortion", 0.1),
                ("lens", 0.0),
            )
        ),
        *((of_clock(*times_s), 40, 40) for times_s in ((0.005, 0.0), (0.1, 0.03))),
        (of_stated_clock, 40, 40),
        (of_mount, 60, 120),
    ],
)  # fmt: skip
def test_errors_are_as_large_as_the_error_bar_says(
    draw: Callable[[int], Drawn], draws: int, independent: int
) -> None:
    """Mean NEES over 6: 0.8 to 1.25, give or take three standard deviations of its draws."""
    squared = list[float]()
    for seed in range(draws):
        rig, table, truth, config = draw(seed)
        squared += squared_errors(solve_joint(rig, table, config), truth)
    scatter = 3 * np.sqrt(2 / 6 / independent)
    assert 0.8 - scatter < np.mean(squared) / 6 < 1.25 + scatter
