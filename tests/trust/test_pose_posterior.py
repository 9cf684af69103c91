"""How wide the images' evidence is, the error bar that it leads to, and samples of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from calibgraph import Dataset, Rig, load_dataset, load_rig
from calibgraph.audit.judgement import judge_camera, tolerance_twist
from calibgraph.model.error_sources import FLAT
from calibgraph.model.geometry import twist_between
from calibgraph.model.metrics import perturb
from calibgraph.pipeline import to_calibration
from calibgraph.solver.joint import solve_joint
from calibgraph.trust.assess import assess
from calibgraph.trust.evidence import Evidence
from calibgraph.trust.pose_posterior import (
    REACH,
    PosePosterior,
    group_tied,
    measure_posteriors,
    sample_posterior,
    widen,
)
from calibgraph.trust.probability import TABLES, judge
from tests.trust.conftest import SAMPLE, simulated

Array = NDArray[np.float64]
NAME = "front_left"
WIDE = np.diag((REACH / 2) ** 2)
BY_MATCHES = np.diag((REACH / 10) ** 2)  # 0.1 deg and 2.5 cm
TOLERANCE = 0.5, 10.0


def certain(covariance: Array) -> PosePosterior:
    """The rounds ended where the matches say, no doubt; samples of exactly this covariance."""
    near = np.sqrt(6) * np.linalg.cholesky(covariance).T
    return PosePosterior(np.concatenate([near, -near]), np.zeros((1, 6)), 0.0)


@pytest.fixture(scope="module")
def measured(dataset: Dataset, truth: Rig) -> Callable[[str], PosePosterior]:
    """About the truth and a wrong result, with the ratio of the truth, and of a pose 1 deg off."""
    wrong = perturb(truth, rotation_deg=0.8, translation_m=0.1, seed=3)
    away = perturb(truth, rotation_deg=1.0, translation_m=0.1, seed=4)
    cases = {"right": (truth, truth), "wrong": (wrong, truth), "off": (truth, away)}

    @cache
    def measure(case: str) -> PosePosterior:
        rig, asked = cases[case]
        given = {NAME: BY_MATCHES}, [(NAME,)]
        return measure_posteriors(dataset, rig, *given, asked=asked.T_camera_lidar)[NAME]

    return measure


def random_covariance(size: int, seed: int) -> Array:
    root = np.random.default_rng(seed).standard_normal((size, 2 * size))
    return np.asarray(root @ root.T)


def test_images_with_structure_tell_the_pose_to_a_tenth_of_a_degree(
    measured: Callable[[str], PosePosterior],
) -> None:
    found = measured("right")
    sigmas = np.sqrt(np.diag(found.moments))
    assert np.degrees(sigmas[:3].max()) < 0.1
    assert 100 * sigmas[3:].max() < 4
    assert found.share < 0.01  # that ends elsewhere, 0.1 %


@pytest.mark.ci
@pytest.mark.slow
def test_about_a_wrong_result_it_reaches_as_far_as_the_truth_and_favours_it(
    measured: Callable[[str], PosePosterior],
) -> None:
    right, wrong = measured("right"), measured("wrong")
    assert np.degrees(np.sqrt(np.trace(wrong.moments[:3, :3]))) > 0.5
    assert wrong.probability_beyond(BY_MATCHES, TOLERANCE) > 0.9
    assert max(right.log_ratio, wrong.log_ratio) < 16 < measured("off").log_ratio


def test_cameras_are_elsewhere_together_if_their_relative_pose_is_known() -> None:
    known, loose = np.diag((0.05 * REACH) ** 2), np.diag((0.05 * REACH) ** 2)
    loose[3, 3] = (0.2 * REACH[3]) ** 2
    pairs = [("a", "c", known), ("c", "d", known), ("a", "b", loose), ("a", "held", known)]
    assert group_tied(["a", "b", "c", "d"], pairs) == [("a", "c", "d"), ("b",)]


def test_tied_cameras_move_by_one_motion_of_the_cloud() -> None:
    """Displaced together, both are found where they were."""
    truth = load_rig(SAMPLE / "reference.yaml")
    dataset = load_dataset(SAMPLE, truth, frames="0:3")
    step = gtsam.Pose3.Expmap(np.array([0.0, 0.0, 0.008, 0.05, 0.0, 0.0])).matrix()
    off = truth.moved_to({name: T @ step for name, T in truth.T_camera_lidar.items()})
    names = list(truth.cameras)[:2]
    covariances = dict.fromkeys(names, np.diag(REACH**2))
    found = measure_posteriors(dataset, off, covariances, [names])
    assert found[names[0]].share == found[names[1]].share
    for name in names:
        back = twist_between(truth.T_camera_lidar[name], off.T_camera_lidar[name])
        mean = found[name].near.mean(axis=0)
        assert np.degrees(np.linalg.norm((mean - back)[:3])) < 0.1
        assert np.linalg.norm((mean - back)[3:]) < 0.04


def test_a_narrower_posterior_leaves_the_covariance_as_it_is() -> None:
    joint = random_covariance(12, seed=0)
    found = widen(joint, {0: joint[:6, :6] / 2, 1: joint[6:, 6:] / 3})
    np.testing.assert_allclose(found, joint, rtol=1e-9)


def test_no_direction_is_narrower_than_by_the_matches_or_by_the_images() -> None:
    joint, moments = random_covariance(12, seed=0), 2 * random_covariance(6, seed=1)
    found = widen(joint, {1: moments})
    for least in (joint[6:, 6:], moments):
        assert np.linalg.eigvalsh(found[6:, 6:] - least).min() > -1e-9
    np.testing.assert_allclose(found[:6, :6], joint[:6, :6])


def test_flat_evidence_widens_the_error_bar_and_is_named_as_its_source(pair: Rig) -> None:
    solution = solve_joint(pair, simulated(pair, frames=20))
    plain = Evidence(solution, pair)
    flat = Evidence(solution, pair, {"left": certain(WIDE)})
    narrow, wide = (np.sqrt(np.diag(each.covariance_of("left"))) for each in (plain, flat))
    assert (wide > 3 * narrow).all()
    sources = flat.error_sources["left"]
    assert sources.rotation[FLAT] > 0.8
    assert sum(sources.rotation.values()) == pytest.approx(1.0)
    assert "walls, poles or vehicles would help most" in sources.describe((0.5, 10.0))
    assert FLAT not in plain.error_sources["left"].rotation


def test_no_deployed_pose_is_wrong_that_the_images_alone_allow(pair: Rig) -> None:
    """The error bar is narrow in both cases."""
    deployed = perturb(pair, rotation_deg=0.8, translation_m=0.0, seed=1)
    solution = solve_joint(pair, simulated(pair, frames=20))
    for elsewhere, status in ((WIDE, "CANNOT TELL"), (1e-3 * WIDE, "WRONG")):
        found = replace(certain(1e-3 * WIDE), elsewhere=certain(elsewhere).near)
        evidence = Evidence(solution, deployed, {"left": found})
        audit = judge_camera(evidence, "left", "", tolerance_twist(0.5, 10.0))
        assert audit.status == status
        assert audit.sigma is not None and np.degrees(audit.sigma[:3].max()) < 0.1


@pytest.mark.parametrize(
    ("wider", "status", "verdict"),
    [(2.0, "PASS", "PASS"), (4.0, "WARN", "PASS"), (40, "WARN", "WARN")],
)
def test_a_wider_surface_is_doubt_of_the_error_bar_alone_and_no_check_fails(
    pair: Rig, wider: float, status: str, verdict: str
) -> None:
    """The check states how much wider; the verdict is the one without it."""
    solution = solve_joint(pair, simulated(pair, frames=20))
    covariance = Evidence(solution, pair).covariance_of("left")
    evidence = Evidence(solution, pair, {"left": certain(wider**2 * covariance)})
    result = to_calibration(evidence, assess(evidence), unseen=evidence.cameras)
    found = result.camera_verdicts["left"]
    (check,) = (each for each in found.checks if each.kind == "flat_evidence")
    assert check.status == status
    assert check.value == pytest.approx(wider)
    assert (found.status, found.cannot_tell) == (verdict, verdict == "WARN")
    assert found.error_probability.by_checks < 0.01
    others = tuple(each for each in found.checks if each is not check)
    without = judge(others, found.error_probability.by_error_bar, TOLERANCE, TABLES)
    assert (without.status, without.cannot_tell) == (found.status, found.cannot_tell)
    assert without.error_probability == found.error_probability


SIGMAS = np.array([1.0, 2.0, 1.0, 0.5, 1.0, 1.0])
PRIOR = np.diag(SIGMAS**2)


def gaussian(mean: Array, sigmas: Array, points: Array) -> Array:
    """(n,) logarithms, 0 at the top."""
    return np.asarray(-0.5 * (((points - mean) / sigmas) ** 2).sum(axis=1))


def test_where_the_likelihood_is_flat_the_samples_are_of_the_prior() -> None:
    tied = PRIOR.copy()
    tied[0, 1] = tied[1, 0] = 1.8
    found, evidence = sample_posterior(lambda p: np.zeros(len(p)), tied, samples=4000, seed=0)
    np.testing.assert_allclose(np.cov(found.T), tied, atol=0.2)
    assert evidence == pytest.approx(0.0)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_mode_that_few_samples_of_the_prior_would_hit_is_found(seed: int) -> None:
    """One of 10^8 of these lies in it; the evidence is that of two Gaussians' product."""
    mean, sigmas = 0.5 * SIGMAS, 0.04 * SIGMAS
    found, evidence = sample_posterior(
        lambda p: gaussian(mean, sigmas, p), PRIOR, samples=1000, seed=seed
    )
    np.testing.assert_allclose(found.mean(axis=0), mean, atol=0.02)
    np.testing.assert_allclose(found.std(axis=0), sigmas, rtol=0.3)
    both = SIGMAS**2 + sigmas**2
    expected = np.log(sigmas**2 / both).sum() / 2 - (mean**2 / both).sum() / 2
    assert evidence == pytest.approx(expected, abs=1.0)


def test_both_of_two_modes_are_found() -> None:
    mean, sigmas = np.array([1.0, 0, 0, 0, 0, 0]), 0.2 * SIGMAS

    def two(points: Array) -> Array:
        first, second = (gaussian(sign * mean, sigmas, points) for sign in (-1, 1))
        return np.logaddexp(first, second)

    found, _ = sample_posterior(two, PRIOR, samples=2000, seed=0)
    density = two(found) - 0.5 * np.einsum("ni,ij,nj->n", found, np.linalg.inv(PRIOR), found)
    assert density[0] == density.max()
    assert 0.3 < (found[:, 0] > 0).mean() < 0.7
    assert np.sqrt((found[:, 0] ** 2).mean()) == pytest.approx(1.0, rel=0.1)
