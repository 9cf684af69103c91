"""Evidence from images and clouds, and the record of it in a saved table."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import calibgraph
from calibgraph import Calibration, Config, CorrespondenceError, Correspondences, Dataset, Rig
from calibgraph.io.clouds import load_cloud
from calibgraph.model.findings import IMAGES
from calibgraph.model.verdict import Check
from calibgraph.pipeline import to_calibration
from calibgraph.solver.joint import solve_joint
from calibgraph.trust import image_evidence
from calibgraph.trust.assess import assess
from calibgraph.trust.evidence import Evidence, by_camera
from calibgraph.trust.image_evidence import check_images
from calibgraph.trust.image_record import to_metadata
from calibgraph.trust.inputs import displacement_of_parts
from calibgraph.trust.pose_posterior import PosePosterior
from tests.conftest import SAMPLE, make_pair
from tests.draws.lenses import with_known_lenses
from tests.trust.conftest import simulated

NAME = "front_left"


@pytest.fixture
def no_lens(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the fit of the lens, which takes most of the time."""
    monkeypatch.setattr(image_evidence, "measure_lens", lambda *_, **__: ())


def with_clouds_of(dataset: Dataset, order: list[int]) -> Dataset:
    frames = dataset.frames
    swapped = [
        replace(frame, cloud_path=frames[other].cloud_path)
        for frame, other in zip(frames, order, strict=True)
    ]
    return replace(dataset, frames=tuple(swapped))


def checks_of(dataset: Dataset, rig: Rig) -> dict[str, Check]:
    """Of one camera, by kind."""
    found = check_images(dataset, rig.model_copy(update={"cameras": {NAME: rig.cameras[NAME]}}))
    return {check.kind: check for _, check in found}


def test_all_checks_pass_at_the_truth(dataset: Dataset, truth: Rig) -> None:
    found = checks_of(dataset, truth)
    assert {check.status for check in found.values()} == {"PASS"}
    assert found.keys() > {"displaced_z_score", "own_clouds", "focal_length"}
    assert found["frames_best"].value == 1.0


@pytest.mark.usefixtures("no_lens")
def test_mispaired_clouds_fail_and_point_to_the_neighbour(dataset: Dataset, truth: Rig) -> None:
    check = checks_of(with_clouds_of(dataset, [1, 2, 3, 4, 5, 0]), truth)["own_clouds"]
    assert check.status == "FAIL" and "clouds of the previous frame better" in check.text


@pytest.mark.usefixtures("no_lens")
def test_a_single_mispaired_frame_is_named(dataset: Dataset, truth: Rig) -> None:
    check = checks_of(with_clouds_of(dataset, [0, 1, 2, 5, 4, 5]), truth)["frames_best"]
    assert check.status == "PASS" and check.value == 5 / 6


@pytest.mark.usefixtures("no_lens")
def test_a_camera_that_turns_halfway_is_no_pass(
    dataset: Dataset, truth: Rig, tmp_path: Path
) -> None:
    """Its first frames agree on one pose, and matches of the others are left out."""
    camera, frames = truth.cameras[NAME], list(dataset.frames)
    k = camera.intrinsics_px
    K = np.array([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]])
    warp = K @ Rotation.from_euler("y", 2.0, degrees=True).as_matrix() @ np.linalg.inv(K)
    for number in (3, 4, 5):
        path = tmp_path / f"{number}.png"
        image = cv2.imread(str(frames[number].image_paths[NAME]))
        cv2.imwrite(str(path), cv2.warpPerspective(image, warp, image.shape[1::-1]))
        paths = {**frames[number].image_paths, NAME: path}
        frames[number] = replace(frames[number], image_paths=paths)
    check = checks_of(replace(dataset, frames=tuple(frames)), truth)["frames_best"]
    assert check.status == "WARN"
    assert "000003, 000004, 000005 fit another extrinsic better" in check.text


@pytest.mark.usefixtures("no_lens")
def test_mispaired_clouds_are_detected_though_their_neighbours_were_not_selected(
    dataset: Dataset, truth: Rig
) -> None:
    late = with_clouds_of(dataset, [1, 2, 3, 4, 5, 5]).select("0:5:2")
    check = checks_of(late, truth)["own_clouds"]
    assert check.value < 0 and "clouds of the previous frame better" in check.text


def test_a_wrong_optimum_fails(dataset: Dataset, truth: Rig) -> None:
    displaced = calibgraph.perturb(truth, rotation_deg=1.2, translation_m=0.1)
    assert "FAIL" in {check.status for check in checks_of(dataset, displaced).values()}


def test_a_camera_without_structure_gets_a_warning(
    dataset: Dataset, truth: Rig, tmp_path: Path
) -> None:
    points = np.random.default_rng(0).uniform(5, 6, (10, 4)).astype(np.float32)
    np.save(tmp_path / "few.npy", points)
    frames = tuple(replace(frame, cloud_path=tmp_path / "few.npy") for frame in dataset.frames)
    (check,) = checks_of(replace(dataset, frames=frames), truth).values()
    assert check.status == "WARN" and "structure in both image and cloud" in check.text


CLOUD = load_cloud(SAMPLE / "lidar" / "000000.npy")
TURN = Rotation.from_euler("xyz", [1, -1, 2], degrees=True)
SHIFT_M = np.float32([0.2, -0.15, 0.1])


@pytest.mark.parametrize(
    ("first", "second"),
    [(CLOUD[::2], CLOUD[1::2]), (CLOUD, CLOUD[::3]), (CLOUD[::4], CLOUD)],
    ids=["equal", "small_last", "small_first"],
)
def test_parts_apart_are_measured(first: np.ndarray, second: np.ndarray) -> None:
    found = displacement_of_parts(
        np.concatenate([first[:, :3], TURN.apply(second[:, :3]) + SHIFT_M])
    )
    expected = np.degrees(TURN.magnitude()), np.linalg.norm(SHIFT_M)
    np.testing.assert_allclose(found, expected, atol=0.1)  # points 10 cm apart, errors of 2 cm


@pytest.mark.parametrize(
    "cloud",
    [
        CLOUD,
        np.concatenate([CLOUD[::2], CLOUD[1::2]]),
        CLOUD[np.argsort(np.arctan2(CLOUD[:, 1], CLOUD[:, 0]))],
        CLOUD[np.argsort(CLOUD[:, 2] / np.linalg.norm(CLOUD[:, :2], axis=1))],
        CLOUD[:150],
    ],
    ids=["scan", "joined_well", "sweep", "rings", "sparse"],
)
def test_parts_that_agree_are_left_alone(cloud: np.ndarray) -> None:
    assert displacement_of_parts(cloud) is None


@pytest.mark.realdata
def test_no_real_cloud_is_named(realdata: Path) -> None:
    clouds = [*realdata.glob("*/lidar/*"), *realdata.glob("kitti_odometry/sequences/*/velodyne/*")]
    assert len(clouds) > 30
    assert [path for path in clouds[::3] if displacement_of_parts(load_cloud(path))] == []


Run = tuple[Calibration, Correspondences]
CAMERA, OTHER = "left", "right"
FLAT = 0.01 * np.random.default_rng(1).standard_normal((50, 6))
"""Half a degree, a centimetre."""
FAILED = Check("own clouds", "FAIL", "the images fit the clouds of the next frame better", -0.2)
CAUSE = Check("convention of the guess", "FAIL", "T_camera_lidar is inverted")


@pytest.fixture(scope="module")
def left_by_run(pair: Rig) -> Run:
    """The result of a run that saw flat evidence of one camera, and a fault; and its table."""
    solution = solve_joint(pair, simulated(pair, frames=20))
    posterior = PosePosterior(0.1 * FLAT, FLAT, 0.3)
    evidence = Evidence(solution, pair, {CAMERA: posterior})
    of_solution, table = assess(evidence), solution.correspondences
    causes, of_run = (by_camera(pair.cameras, iter([(CAMERA, of)])) for of in (CAUSE, FAILED))
    checks = {name: causes[name] + of_solution[name] + of_run[name] for name in pair.cameras}
    seen = table.with_metadata({**table.metadata, **to_metadata(evidence, causes, of_run)})
    return to_calibration(evidence, checks), seen


@pytest.fixture(scope="module")
def pair() -> Rig:
    return make_pair()


def test_covariance_and_verdict_of_the_saved_table_are_those_of_the_run(
    left_by_run: Run, tmp_path: Path, pair: Rig
) -> None:
    made, table = left_by_run
    table.save(tmp_path / "table.parquet")
    again = calibgraph.solve(made.initial_rig, tmp_path / "table.parquet")
    for name in made.rig.cameras:
        sigmas = np.sqrt(np.diag(made.covariance[name]))
        apart = (again.covariance[name] - made.covariance[name]) / np.outer(sigmas, sigmas)
        np.testing.assert_allclose(apart, 0.0, atol=1e-3)
        mine, theirs = (r.camera_verdicts[name] for r in (made, again))
        assert [(c.name, c.status) for c in mine.checks] == [
            (c.name, c.status) for c in theirs.checks
        ]
        assert mine.status == theirs.status
    checks = again.camera_verdicts[CAMERA].checks
    assert checks[0] == CAUSE and checks[-1] == FAILED
    without = calibgraph.solve(with_known_lenses(pair), table.with_metadata({}))
    assert np.trace(without.covariance[CAMERA]) < 0.1 * np.trace(again.covariance[CAMERA])


@pytest.mark.parametrize(
    ("moved_m", "status", "words"),
    [(0.5, "FAIL", "its images exclude this pose"), (0.01, "WARN", "from this one")],
)
def test_what_images_said_of_another_pose_is_not_of_this_one(
    left_by_run: Run, moved_m: float, status: str, words: str
) -> None:
    """The posterior, which covers its surroundings, is, and may exclude it; the checks are not."""
    made, table = left_by_run
    T = made.T_camera_lidar[CAMERA]
    step = np.eye(4)
    step[0, 3] = moved_m
    points = table.points_lidar_m.copy()
    own = table.camera_index == table.cameras.index(CAMERA)
    inverse = np.linalg.inv(T) @ step @ T
    points[own] = points[own] @ inverse[:3, :3].T + inverse[:3, 3]
    found = calibgraph.solve(made.rig, replace(table, points_lidar_m=points))
    verdict = found.camera_verdicts[CAMERA]
    assert FAILED not in verdict.checks and CAUSE not in verdict.checks
    (said,) = images_of(found, CAMERA)
    assert said.status == status and words in said.text
    assert not images_of(found, OTHER)
    assert verdict.status == status and verdict.cannot_tell == (status == "WARN")
    assert found.covariance[CAMERA][3, 3] > (0.8 * moved_m) ** 2


def test_what_images_said_with_another_lens_is_not_of_this_one(left_by_run: Run) -> None:
    made, table = left_by_run
    camera = made.rig.cameras[CAMERA]
    lens = camera.intrinsics_px.model_copy(update={"fx": 1.02 * camera.intrinsics_px.fx})
    cameras = {**made.rig.cameras, CAMERA: camera.model_copy(update={"intrinsics_px": lens})}
    found = calibgraph.solve(made.rig.model_copy(update={"cameras": cameras}), table)
    said = images_of(found, CAMERA)
    assert [check.status for check in said] == ["WARN"] and "another lens" in said[0].text
    assert "flat_evidence" not in [check.kind for check in found.camera_verdicts[CAMERA].checks]


def test_a_fault_of_one_camera_stays_where_another_has_moved(left_by_run: Run) -> None:
    made, table = left_by_run
    pixels = table.pixels_px.copy()
    pixels[table.camera_index == table.cameras.index(OTHER)] += 5.0
    found = calibgraph.solve(made.rig, replace(table, pixels_px=pixels))
    assert FAILED in found.camera_verdicts[CAMERA].checks
    assert not images_of(found, CAMERA)
    (said,) = images_of(found, OTHER)
    assert "from this one" in said.text


@pytest.mark.parametrize(("tolerance", "kept"), [((0.2, 4.0), True), ((2.0, 60.0), False)])
def test_checks_of_another_tolerance_are_no_pass(
    left_by_run: Run, tolerance: tuple[float, float], kept: bool
) -> None:
    """What failed at a wider one fails at this; at a wider than that it is not known."""
    made, table = left_by_run
    deg, cm = tolerance
    found = calibgraph.solve(made.rig, table, Config(tolerance_deg=deg, tolerance_cm=cm))
    assert (FAILED in found.camera_verdicts[CAMERA].checks) == kept
    for name in (CAMERA, OTHER):
        (said,) = images_of(found, name)
        assert said.status == "WARN" and "a tolerance of 0.5 deg, 10 cm" in said.text


def images_of(found: Calibration, name: str) -> list[Check]:
    return [check for check in found.camera_verdicts[name].checks if check.name == "images"]


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("near", "AAAA"),
        ("near", "no base64!"),
        ("near", 5),
        ("near", None),
        ("elsewhere", [[1, 2]]),
        ("share", "much"),
        ("share", np.nan),
        ("share", 50),
    ],
)
def test_a_malformed_record_is_one_line(left_by_run: Run, path: str, value: object) -> None:
    made, table = left_by_run
    record = table.metadata[IMAGES]
    cameras = dict(record["cameras"])
    posterior = {**cameras[CAMERA]["posterior"], path: value}
    cameras[CAMERA] = {**cameras[CAMERA], "posterior": posterior}
    wrong = table.with_metadata({**table.metadata, IMAGES: {"cameras": cameras}})
    with pytest.raises(CorrespondenceError, match=f"metadata '{IMAGES}': .*{path}"):
        calibgraph.solve(made.rig, wrong)
