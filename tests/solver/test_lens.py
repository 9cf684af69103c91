"""Lenses that are estimated with the extrinsics: found, not overrated, and exact in the graph."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from calibgraph import Config, MatcherErrors, Rig, simulate_correspondences, solve
from calibgraph.graph.latent_poses import latent_pose_graph
from calibgraph.graph.lens import LensVariable
from calibgraph.graph.variables import lens_key
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.geometry import twist_between
from calibgraph.model.rig import IntrinsicsSigma
from calibgraph.simulation.rigs import rig_of
from calibgraph.solver.joint import solve_joint
from calibgraph.solver.lens import lens_estimates
from calibgraph.solver.solution import Solution
from tests.draws.lenses import put_lens_error, with_fields, with_known_lenses
from tests.solver.latent import all_values, reported_keys
from tests.solver.test_places import STATED, minimize

ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=1.0, outlier_share=0.15)
ORDERS_OF = {"fisheye": ("k1", "k2", "k3", "k4"), "omni": ("xi", "k1", "k2", "p1", "p2")}
Drawn = tuple[Rig, Correspondences]
FIVE_SIGMAS = 5.0  # one of 3 million


@pytest.fixture(scope="module")
def drawn() -> Drawn:
    """Two cameras like KITTI's, and matches of ten frames."""
    return simulated(seed=0, frames=10, matches=150)


def simulated(seed: int, frames: int, matches: int) -> tuple[Rig, Correspondences]:
    rig = rig_of("kitti")
    return rig, simulate_correspondences(
        rig, frames=frames, matches=matches, errors=ERRORS, seed=seed
    )


def squared_errors(found: Solution, truth: Rig) -> list[float]:
    """Per camera, the squared error of its pose in the metric of its covariance."""
    squared = []
    for number, (name, T) in enumerate(found.T_camera_lidar.items()):
        own = found.covariance[6 * number : 6 * number + 6, 6 * number : 6 * number + 6]
        twist = twist_between(T, truth.cameras[name].T_camera_lidar)
        squared.append(float(twist @ np.linalg.solve(own, twist)))
    return squared


def known_to(rig: Rig, focal_px: float) -> Rig:
    return with_fields(rig, intrinsics_sigma_px=IntrinsicsSigma(focal=focal_px))


@pytest.mark.parametrize(
    ("part", "error"), [("focal", 0.05), ("centre", 30.0), ("distortion", 0.1)]
)
def test_a_wrong_lens_is_found(drawn: Drawn, part: str, error: float) -> None:
    truth, table = drawn
    wrong = put_lens_error(truth, part, error)
    found = solve_joint(wrong, table, Config(estimate=(part,)))
    right = {"focal": 718.856, "centre_x": 607.1928, "centre_y": 185.2157}
    for of_camera in found.lens.values():
        for one in of_camera:
            assert abs(one.value - right.get(one.name, 0.0)) < FIVE_SIGMAS * one.sigma
        assert of_camera[0].is_determined
        assert abs(of_camera[0].value - of_camera[0].prior) > FIVE_SIGMAS * of_camera[0].sigma
    assert max(squared_errors(found, truth)) < chi2.isf(1e-6, 6)


def test_a_lens_beyond_what_the_rig_allows_is_no_pass(drawn: Drawn) -> None:
    """4 % of a focal length that is stated to 0.1 %."""
    rig, table = drawn
    wrong = put_lens_error(rig, "focal", 0.04)
    focal_px = 0.001 * wrong.cameras["image_2"].intrinsics_px.fx
    for known, status in ((wrong, "PASS"), (known_to(wrong, focal_px), "WARN")):
        result = solve(known, table, Config(estimate="focal", common_deg=0.0))
        for verdict in result.camera_verdicts.values():
            (check,) = [one for one in verdict.checks if one.kind == "lens_prior"]
            assert check.status == verdict.status == status


def test_a_lens_that_is_known_exactly_changes_nothing(drawn: Drawn) -> None:
    """Its excess displaces pose and lens together, so that nothing of it is left."""
    truth, table = drawn
    exact = with_known_lenses(truth)
    fixed, free = (solve_joint(exact, table, Config(estimate=of)) for of in ((), ("focal",)))
    sigmas = np.sqrt(np.diag(fixed.covariance))
    for number, name in enumerate(truth.cameras):
        twist = twist_between(free.T_camera_lidar[name], fixed.T_camera_lidar[name])
        # The matches' pull on a focal length 1e-4 px (1e-7) off displaces by 1e-6 m, of 5e-4 m.
        assert np.abs(twist / sigmas[6 * number : 6 * number + 6]).max() < 0.02
    np.testing.assert_allclose(np.sqrt(np.diag(free.covariance)), sigmas, rtol=0.02)


def test_an_uncertain_lens_widens_the_error_bar(drawn: Drawn) -> None:
    """Along the axis by 1 % of the distances, but for what the matches know of the lens."""
    truth, table = drawn
    known, unknown = (
        solve_joint(rig, table, Config(estimate=("focal",)))
        for rig in (with_known_lenses(truth), known_to(with_known_lenses(truth), 7.0))
    )
    for number, name in enumerate(truth.cameras):
        (one,) = unknown.lens[name]
        assert (one.direction, one.is_determined) == ("z", True)
        ahead = 6 * number + 5
        assert unknown.covariance[ahead, ahead] > 1.1 * known.covariance[ahead, ahead]
        assert known.lens[name][0].describe().startswith("not determined by these data")
        assert known.error_sources(known.covariance)[name]


def test_of_a_lens_an_alignment_errs_by_what_other_scenes_show_and_a_mount_by_all(
    drawn: Drawn,
) -> None:
    """One percent of the focal length is one percent of the distances, along the axis."""
    truth, table = drawn
    alignments, mounts = (
        [solve_joint(known_to(truth, focal_px), table, Config(of=of)) for focal_px in (0.01, 7.2)]
        for of in ("alignment", "mount")
    )
    for number, name in enumerate(truth.cameras):
        ahead = 6 * number + 5
        added = [
            np.sqrt(unknown.covariance[ahead, ahead] - known.covariance[ahead, ahead])
            for known, unknown in (alignments, mounts)
        ]
        assert 0.03 < added[1] < 0.2  # its matches are 5 to 40 m away
        assert 0.2 * added[1] < added[0] < 0.8 * added[1]
        turned = alignments[1].covariance - alignments[0].covariance
        assert np.degrees(np.sqrt(turned[6 * number, 6 * number])) < 0.1
        np.testing.assert_allclose(
            mounts[1].T_camera_lidar[name], alignments[1].T_camera_lidar[name]
        )
        shares = mounts[1].error_sources(mounts[1].covariance)[name].translation
        assert shares["uncertain lenses and clocks"] > 0.9


def test_estimate_and_sigma_are_those_of_the_whole_graph(drawn: Drawn) -> None:
    """By GTSAM's Levenberg-Marquardt and Marginals, with places and scan distortion."""
    truth, table = drawn
    stated = table.with_findings(replace(table.findings, **STATED))
    wrong = put_lens_error(truth, "focal", 0.01)
    found = solve_joint(wrong, stated, Config(estimate=("focal", "centre")))
    fit, graph = found.errors, latent_pose_graph(found.errors.model)
    values = minimize(graph, all_values(fit.linear))
    assert 2 * graph.error(all_values(fit.linear)) == pytest.approx(fit.cost, rel=1e-9)
    assert 2 * graph.error(values) == pytest.approx(fit.cost, rel=1e-5)  # its tolerance is 1e-6
    marginals = gtsam.Marginals(graph, values)
    for number, (name, estimates) in enumerate(lens_estimates(fit)[0].items()):
        own, lens = (
            marginals.marginalCovariance(lens_key(number)),
            values.atVector(lens_key(number)),
        )
        sigmas = np.sqrt(np.diag(own))
        relative = [one.sigma / one.prior_sigma for one in estimates]
        np.testing.assert_allclose(relative, sigmas, rtol=0.01)
        assert np.abs((fit.linear.shared.atVector(lens_key(number)) - lens) / sigmas).max() < 0.02
        rows = slice(6 * number, 6 * number + 6)
        pose = marginals.marginalCovariance(reported_keys(fit)[number]) + fit.by_lenses[rows, rows]
        np.testing.assert_allclose(
            np.sqrt(np.diag(fit.covariance[rows, rows])), np.sqrt(np.diag(pose)), rtol=0.01
        )
        assert name in truth.cameras


def test_the_rig_gets_the_lens_and_without_the_flag_keeps_its_own(drawn: Drawn) -> None:
    truth, table = drawn
    wrong = put_lens_error(truth, "focal", 0.02)
    plain, found = solve(wrong, table), solve(wrong, table, Config(estimate=("focal",)))
    assert plain.lens == {}
    assert plain.rig.with_lenses_of(wrong) is plain.rig
    assert plain.not_included.startswith("intrinsics beyond what the rig states, ")
    assert found.not_included.startswith("other intrinsics beyond what")
    for name, camera in found.rig.cameras.items():
        assert camera.intrinsics_px.fx == pytest.approx(found.lens[name][0].value, rel=1e-9)
        assert found.initial_rig.cameras[name] == wrong.cameras[name]
        assert "estimated lenses and clocks" in found.error_sources[name].translation


@pytest.mark.parametrize("name", ["fisheye", "omni"])
def test_lenses_that_see_all_round_are_estimated(name: str) -> None:
    """Focal length and k1 wrong at once; xi of a unified lens stays."""
    camera, first = next(iter(rig_of(name).cameras.items()))
    truth = Rig(cameras={camera: first})
    table = simulate_correspondences(truth, frames=10, matches=150, errors=ERRORS, seed=0)
    wrong = put_lens_error(put_lens_error(truth, "focal", 0.01), "distortion", 0.02)
    before = solve_joint(with_known_lenses(wrong), table)
    after = solve_joint(wrong, table, Config(estimate="focal,distortion"))
    worst = [max(squared_errors(found, truth)) for found in (before, after)]
    assert worst[1] < chi2.isf(1e-6, 6) < worst[0]
    for camera, estimates in after.lens.items():
        right, found = truth.cameras[camera], after.solved_rig.cameras[camera]
        coefficients = dict(zip(ORDERS_OF[name], right.distortion, strict=True))
        values = {"focal": right.intrinsics_px.fx, **coefficients}
        for one in estimates:
            assert abs(one.value - values[one.name]) < FIVE_SIGMAS * one.sigma
        assert estimates[0].is_determined and estimates[1].is_determined
        if name == "omni":
            assert found.distortion[0] == right.distortion[0]


def test_the_rig_states_how_well_its_new_lens_is_known(drawn: Drawn) -> None:
    truth, table = drawn
    found = solve(truth, table, Config(estimate="lens"))
    for name, estimates in found.lens.items():
        sigmas = {one.name: one.sigma for one in estimates}
        camera, before = found.rig.cameras[name], found.initial_rig.cameras[name]
        assert camera.intrinsics_sigma_px is not None and before.intrinsics_sigma_px is None
        assert camera.intrinsics_sigma_px.focal == pytest.approx(sigmas["focal"], rel=1e-9)
        centre = max(sigmas["centre_x"], sigmas["centre_y"])
        assert camera.intrinsics_sigma_px.centre == centre
        assert camera.distortion_sigma == max(sigmas["k1"], sigmas["k2"])
        assert camera.time_offset_sigma_s is None
    next_prior = LensVariable.of(found.rig.cameras["image_2"], ("focal",)).free.sigmas
    focal = found.lens["image_2"][0]
    assert next_prior[0] == pytest.approx(focal.sigma / focal.value, rel=1e-9)
