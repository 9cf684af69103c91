"""While driving, the error model of a batch: what frames of one place, and all, have in common."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import gtsam
import numpy as np
import pytest

from calibgraph import Config, Correspondences, MatcherErrors, Rig, Update, concatenate
from calibgraph.graph.objective import join
from calibgraph.graph.variables import (
    CLOUD,
    DISTORTION,
    camera_key,
    cloud_at_key,
    matched_at_key,
    matched_key,
)
from calibgraph.model.geometry import (
    relative_covariance,
    relative_transform,
    to_T_camera_lidar,
    to_T_lidar_camera,
    twist_between,
)
from calibgraph.solver.joint import solve_joint
from calibgraph.tracking import DurableCalibrator, IncrementalCalibrator
from calibgraph.tracking.estimate import Terms, every_place
from calibgraph.trust.evidence import Evidence
from tests.conftest import stereo_relative_pose
from tests.draws.places import Drawn, draw_places, tied
from tests.tracking.drives import drive, pair_of, track_draw

Array = np.ndarray

MOUNT = Config(of="mount")
STATED = {
    "systematic_rotation_rad": 0.0015,
    "systematic_translation_m": 0.02,
    "camera_share": 0.6,
    "place_rotation_rad": 0.0007,
    "place_translation_m": 0.006,
    "place_variance": 8.0,
}


def batch_of(drawn: Drawn, **config: object) -> tuple[dict[str, Array], Array]:
    solved = solve_joint(drawn.rig, drawn.table, Config(learnt_weights=False, **config))
    joint = Evidence(solved, drawn.rig).joint_covariance
    return solved.T_camera_lidar, joint


def sigmas_of_pair(T: dict[str, Array], joint: Array) -> Array:
    left, right = T.values()
    return np.sqrt(np.diag(relative_covariance(joint, 0, 1, relative_transform(right, left))))


def drawn_of(places: int, frames: int, rounds: int, *, tie: bool) -> Drawn:
    rng = np.random.default_rng(places)
    drawn = draw_places(places, 100, rng, frames=frames, rounds=rounds)
    return tied(drawn, rng, deg=0.02, cm=0.3) if tie else drawn


@pytest.mark.parametrize("tie", [pytest.param(False, marks=pytest.mark.slow), True])
@pytest.mark.parametrize(
    ("places", "frames", "rounds"), [(1, 20, 1), (2, 10, 1), (6, 5, 1), (3, 5, 2)]
)
def test_places_give_what_a_batch_gives(places: int, frames: int, rounds: int, tie: bool) -> None:
    """Within 0.1 sigma root mean square, and 8 % in the sigmas, of cameras and of the pair.

    The graph is the same; the gate is drawn at, and the spread measured by, other estimates.
    """
    drawn = drawn_of(places, frames, rounds, tie=tie)
    T, joint = batch_of(drawn)
    result = track_draw(drawn)
    found = result.joint_covariance
    apart = [twist_between(result.T_camera_lidar[name], T[name]) for name in T]
    sigmas = np.sqrt(np.diag(joint))
    assert np.sqrt(np.mean(np.square(np.concatenate(apart) / sigmas))) < 0.1
    np.testing.assert_allclose(np.sqrt(np.diag(found)), sigmas, rtol=0.08)
    np.testing.assert_allclose(sigmas_of_pair(T, found), sigmas_of_pair(T, joint), rtol=0.08)


def states(table: Correspondences, **more: object) -> Correspondences:
    return replace(table, metadata={**table.metadata, **STATED, **more})


def cloud_turned(rig: Rig, turn_rad: float) -> Rig:
    """As the cloud, turned about the vertical, shows it."""
    by = gtsam.Pose3.Expmap(np.array([0, 0, turn_rad, 0, 0, 0])).matrix()
    return rig.moved_to({name: T @ by for name, T in rig.T_camera_lidar.items()})


def last_of(tables: list[Correspondences], places: list[str | None]) -> Update:
    tracker = IncrementalCalibrator(pair_of())
    for table, place in zip(tables, places, strict=True):
        update = tracker.update(table, place=place)
    return update


def test_standing_for_long_moves_the_estimate_no_more_than_passing() -> None:
    """Two places, whose clouds are displaced apart, one with ten times the frames of the other.

    By frames the estimate would be at 1 / 11 of the way. Both places have the same error, but for
    that of frames themselves, of which there are few at the second one: so it is before the middle.
    """
    rig = pair_of()
    away = cloud_turned(rig, 0.0014)
    tables = [states(table) for table in drive(rig, 50)]
    tables += [states(replace(table, frame=table.frame + 50)) for table in drive(away, 5, seed=2)]
    update = last_of(tables, ["here"] * 50 + ["there"] * 5)
    turned = twist_between(update.T_camera_lidar["left"], rig.T_camera_lidar["left"])
    whole = twist_between(away.T_camera_lidar["left"], rig.T_camera_lidar["left"])
    assert 0.25 < turned[:3] @ whole[:3] / (whole[:3] @ whole[:3]) < 0.5


def test_a_wrong_place_among_many_hardly_counts() -> None:
    """The cloud is turned by six sigmas at one of ten places."""
    rig, tables = pair_of(), []
    for place in range(10):
        shown = cloud_turned(rig, 0.0042 if place == 4 else 0.0)
        for table in drive(shown, 4, seed=place, matches=100):
            frame = np.full(len(table), 4 * place) + table.frame
            tables.append(states(replace(table, frame=frame)))
    tracker = IncrementalCalibrator(rig)
    for frame, table in enumerate(tables):
        update = tracker.update(table, place=frame // 4)
    turned = twist_between(update.T_camera_lidar["left"], rig.T_camera_lidar["left"])
    assert np.linalg.norm(turned[:3]) < 0.04 * 0.0042 + 3 * 0.0007 / np.sqrt(9)
    weights = dict(zip(tracker._state.settled, tracker._state.weights[:, 0], strict=True))
    assert weights.pop("4") < 0.3
    assert min(weights.values()) > 0.6


def test_relative_poses_share_the_error_of_the_cloud() -> None:
    """Of 0.0015 rad, 60 % of the variance is the cameras' own: twice that is left of the pair."""
    tables = [states(table) for table in drive(pair_of(), 40)]
    tracker = IncrementalCalibrator(pair_of())
    for frame, table in enumerate(tables):
        tracker.update(table, place=frame // 2)
    result = tracker.calibration()
    variance = np.square(sigmas_of_pair(result.T_camera_lidar, result.joint_covariance)[:3])
    expected = 2 * 0.6 * STATED["systematic_rotation_rad"] ** 2
    assert (variance > expected).all() and (variance < 1.5 * expected).all()


def test_a_relative_pose_that_contradicts_takes_no_part() -> None:
    """0.05 rad off, with a sigma of 0.002, of a pair that the matches know to 0.002."""
    rig = pair_of()
    right = stereo_relative_pose(rig).model_copy(update={"rotation_sigma_rad": 0.002})
    turned = gtsam.Pose3.Expmap(np.array([0.0, 0.05, 0, 0, 0, 0])).matrix()
    wrong = right.model_copy(update={"T_a_b": right.T_a_b @ turned})
    tables, results = [states(table) for table in drive(rig, 20)], {}
    for name, pairs in (("none", ()), ("right", (right,)), ("wrong", (wrong,))):
        tracker = IncrementalCalibrator(rig.model_copy(update={"relative_poses": pairs}))
        for table in tables:
            tracker.update(table)
        results[name] = tracker.calibration()
    assert [results[name].verdict.status for name in results] == ["PASS", "PASS", "FAIL"]
    T, off = results["none"].T_camera_lidar, results["wrong"].T_camera_lidar
    for name in T:  # the own estimate, from which all is a quadratic, is moved a little
        assert np.abs(twist_between(off[name], T[name])).max() < 1e-3
    joints = [result.joint_covariance for result in results.values()]
    without, with_right, with_wrong = (
        np.diag(joint)[:3].sum() for joint in joints if joint is not None
    )
    assert with_right < 0.9 * without < 0.9 * 1.05 * with_wrong


# The graph


def tracked_at_three_places(frames: int, **config: object) -> tuple[IncrementalCalibrator, Update]:
    drawn = drawn_of(3, 5, 2, tie=True)
    tracker = IncrementalCalibrator(drawn.rig, Config(**config))
    for frame in range(frames):
        update = tracker.update(drawn.table.select(drawn.table.frame == frame))
    return tracker, update


def whole_graph(tracker: IncrementalCalibrator) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The error model with the poses of all places, by stock factors, and all poses as reported."""
    state, epoch = tracker._state, tracker._graph
    every = every_place(state, epoch.places, state.all_sums())
    rows = np.flatnonzero(every.frames.any(axis=1))
    terms = Terms.of(state, every, rows, epoch.open_spread(state, every))
    graph, no_motion = join(epoch.window.model.shared_graph), gtsam.Pose3()
    poses = [to_T_lidar_camera(T) for T in tracker.rig.T_camera_lidar.values()]
    size = epoch.window.model.components.distortion_jacobian.shape[2]
    at = {CLOUD: no_motion, DISTORTION: np.zeros(size)}
    covariance, information = (
        lambda own: robust(gtsam.noiseModel.Gaussian.Covariance(own), terms.robust_scale),
        gtsam.noiseModel.Gaussian.Information,
    )
    for place in range(len(rows)):
        cloud, of_cloud = cloud_at_key(place), covariance(terms.cloud[place])
        graph.add(gtsam.BetweenFactorPose3(CLOUD, cloud, no_motion, of_cloud))
        at[cloud] = no_motion
        for camera in np.flatnonzero(terms.seen[place]).tolist():
            reference = to_T_lidar_camera(state.references[camera])
            shown = reference.retract(terms.minimum[place, camera])
            key, known = matched_at_key(place, camera), terms.information[place, camera]
            apart = covariance(terms.at_place[place, camera])
            graph.add(gtsam.BetweenFactorPose3(matched_key(camera), key, no_motion, apart))
            graph.add(gtsam.BetweenFactorPose3(cloud, key, shown, information(known)))
            at[key] = poses[camera]
    for of in (camera_key, matched_key):
        at |= {of(camera): pose for camera, pose in enumerate(poses)}
    values = gtsam.Values()
    for key in graph.keyVector():
        values.insert(key, at[key])
    return graph, values


def robust(noise: gtsam.noiseModel.Gaussian, scale: float) -> gtsam.noiseModel.Base:
    if not np.isfinite(scale):
        return noise
    return gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.GemanMcClure.Create(scale), noise
    )


def test_what_is_reported_is_optimum_and_marginal_of_the_graph() -> None:
    """By GTSAM's LM and Marginals: within 0.02 sigma, and half a percent of the covariance.

    Places have the weights in their robust loss that they had at the end of the last epoch.
    """
    tracker, update = tracked_at_three_places(24)
    graph, start = whole_graph(tracker)
    values = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    marginals = gtsam.Marginals(graph, values)
    model = tracker._graph.window.model
    expected, rows = model.reported(values, "alignment")
    joint = rows @ marginals.jointMarginalCovariance([*model.columns]).fullMatrix() @ rows.T
    for camera, name in enumerate(("left", "right")):
        own = slice(6 * camera, 6 * camera + 6)
        reported = update.covariance[name]
        found = joint[own, own] + tracker._state.lens_errors[camera]
        units = np.sqrt(np.outer(np.diag(reported), np.diag(reported)))
        np.testing.assert_allclose(found / units, reported / units, atol=5e-3)
        T = expected[camera]
        apart = twist_between(update.T_camera_lidar[name], T) / np.sqrt(np.diag(reported))
        assert np.abs(apart).max() < 0.02


def test_with_a_preset_of_the_paper_the_estimate_is_that_of_equation_5() -> None:
    """Priors, and a quadratic per camera."""
    tracker, update = tracked_at_three_places(12, preset="kitti")
    state, values = tracker._state, gtsam.Values()
    graph, sums = join(tracker._graph.pose_graph), state.all_sums()
    for camera, T in enumerate(update.T_camera_lidar.values()):
        key, at = camera_key(camera), gtsam.Values()
        at.insert(key, to_T_lidar_camera(state.references[camera]))
        own = gtsam.HessianFactor(key, sums.hessian[camera], -sums.gradient[camera], 0.0)
        graph.add(gtsam.LinearContainerFactor(own, at))
        values.insert(key, to_T_lidar_camera(T))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    for camera, (name, T) in enumerate(update.T_camera_lidar.items()):
        own = to_T_camera_lidar(found.atPose3(camera_key(camera)))
        covariance = update.covariance[name]
        assert np.abs(twist_between(own, T) / np.sqrt(np.diag(covariance))).max() < 0.01


def test_a_camera_that_is_blind_at_new_places_stops_nothing() -> None:
    """Its error bar stays that of the places where it saw something."""
    tracker = IncrementalCalibrator(pair_of())
    for frame, table in enumerate(drive(pair_of(), 40)):
        seen = states(table if frame < 25 else table.of_camera("left"))
        update = tracker.update(seen, place=str(frame // 6))
        sigmas = {name: np.sqrt(np.diag(own)) for name, own in update.covariance.items()
                  if own is not None}  # fmt: skip
        if frame == 24:
            before = sigmas
    np.testing.assert_allclose(sigmas["right"], before["right"], rtol=0.2)
    assert (sigmas["left"][:3] < before["left"][:3]).all()


def test_a_camera_that_sees_a_place_later_than_another_is_taken_in() -> None:
    """Its variable at a place that the open epoch has already begins another window."""
    tracker = IncrementalCalibrator(pair_of())
    for frame, table in enumerate(drive(pair_of(), 40)):
        seen = table.of_camera("left") if frame in (24, 25) else table
        tracker.update(states(seen), place="here" if frame < 24 else "there")
    counts = tracker.calibration().counts
    assert [counts[name]["frames_used"] for name in ("left", "right")] == [40, 38]


# Where the place of a frame comes from


def test_places_are_there_after_a_restart(tmp_path: Path) -> None:
    """With summaries of places, within the steps that an epoch's end leaves, and between them."""
    tables = [states(table) for table in drive(pair_of(), 82)]
    config, cuts = Config().changed(tracking={"live_epochs": 1}), (0, 41, 63, 69, 70, len(tables))
    whole = IncrementalCalibrator(pair_of(), config)
    for start, end in pairwise(cuts):
        with DurableCalibrator(tmp_path / "state", pair_of(), config) as calibrator:
            for frame in range(start, end):
                found = calibrator.update(tables[frame], place=frame // 4 % 3)
                expected = whole.update(tables[frame], place=frame // 4 % 3)
    for name, T in expected.T_camera_lidar.items():
        np.testing.assert_array_equal(found.T_camera_lidar[name], T)
        np.testing.assert_array_equal(found.covariance[name], expected.covariance[name])


def test_a_new_place_is_no_move() -> None:
    """The cloud turned by 0.1 deg, two sigmas of a place, after 80 frames of another place."""
    rig = pair_of()
    away = cloud_turned(rig, 0.0018)
    tables = [states(table) for table in drive(rig, 80, matches=300)]
    tables += [
        states(replace(table, frame=table.frame + 80))
        for table in drive(away, 60, matches=300, seed=2)
    ]

    def events(
        tracker: IncrementalCalibrator, tables: list[Correspondences], place: str
    ) -> list[str]:
        updates = [tracker.update(table, place=place) for table in tables]
        found = [event.kind for update in updates for event in update.events]
        return [kind for kind in found if kind != "started"]

    tracker = IncrementalCalibrator(rig)
    assert not events(tracker, tables[:80], "here")
    other = IncrementalCalibrator.from_bytes(tracker.to_bytes())
    assert events(tracker, tables[80:], "here") == ["moved"]
    assert not events(other, tables[80:], "there")


def test_a_frame_of_another_place_disagrees_by_what_places_differ_by() -> None:
    """The cloud turned, of matches so good that none of the old estimate is left within the gate.

    By 0.0025 rad, 3.6 sigmas of a place, which is a move where the vehicle stands; and by 0.02 rad,
    which is one anywhere.
    """
    rig, good = pair_of(), MatcherErrors(noise_px=0.2, frame_noise_px=0.1, outlier_share=0.1)

    def found(turn_rad: float, place: str) -> tuple[list[str], int]:
        away = cloud_turned(rig, turn_rad)
        tables = drive(rig, 25, errors=good)
        tables += [
            replace(table, frame=table.frame + 25) for table in drive(away, 8, errors=good, seed=2)
        ]
        tracker, kinds, left_out = IncrementalCalibrator(rig), [], 0
        for frame, table in enumerate(tables):
            update = tracker.update(states(table), place="here" if frame < 25 else place)
            kinds += [event.kind for event in update.events if event.kind != "started"]
            left_out += len(update.left_out)
        return kinds, left_out

    assert found(0.0025, "there") == ([], 0)
    for turn_rad, place in ((0.0025, "here"), (0.02, "there")):
        kinds, left_out = found(turn_rad, place)
        assert set(kinds) == {"moved"} and left_out > 0


def test_bends_widen_the_error_bar_as_in_a_batch_and_survive_a_restart(tmp_path: Path) -> None:
    """Of cameras that look 90 degrees apart; motion displaces their views by other amounts."""
    rig = pair_of()
    turn = np.eye(4)
    turn[:3, :3] = gtsam.Rot3.Ry(np.pi / 2).matrix()
    rig = rig.moved_to(
        {"left": rig.T_camera_lidar["left"], "right": turn @ rig.T_camera_lidar["left"]}
    )
    tables = drive(rig, 12)
    sigmas = {}
    for motion_m in (0.0, 0.2):
        with DurableCalibrator(tmp_path / str(motion_m), rig, MOUNT) as tracker:
            for table in tables:
                tracker.update(states(table, scan_motion_m=motion_m))
            result = tracker.tracker.calibration()
        with DurableCalibrator(tmp_path / str(motion_m), rig, MOUNT) as tracker:
            again = tracker.tracker.calibration()
        np.testing.assert_array_equal(again.joint_covariance, result.joint_covariance)
        sigmas[motion_m] = sigmas_of_pair(result.T_camera_lidar, result.joint_covariance)
        T, joint = batch_of(
            Drawn(rig, states(concatenate(tables), scan_motion_m=motion_m)), of="mount"
        )
        np.testing.assert_allclose(sigmas[motion_m], sigmas_of_pair(T, joint), rtol=0.1)
    assert sigmas[0.2][3:].max() > 1.1 * sigmas[0.0][3:].max()
