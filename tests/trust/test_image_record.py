"""A table that a run left, solved again, is as sure as the run, and not surer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import calibgraph
from calibgraph import Calibration, Config, CorrespondenceError, Correspondences, Rig
from calibgraph.model.findings import IMAGES
from calibgraph.model.verdict import Check
from calibgraph.pipeline import to_calibration
from calibgraph.solver.joint import solve_joint
from calibgraph.trust.assess import assess
from calibgraph.trust.evidence import Evidence
from calibgraph.trust.image_record import RunChecks, to_metadata
from calibgraph.trust.pose_posterior import PosePosterior
from tests.conftest import make_pair
from tests.trust.conftest import simulated

CAMERA, OTHER = "left", "right"
FLAT = 0.01 * np.random.default_rng(1).standard_normal((50, 6))
"""Half a degree, a centimetre."""
FAILED = Check("own clouds", "FAIL", "the images fit the clouds of the next frame better", -0.2)
CAUSE = Check("convention of the guess", "FAIL", "T_camera_lidar is inverted")


@pytest.fixture(scope="module")
def left_by_run(pair: Rig) -> tuple[Calibration, Correspondences]:
    """The result of a run that saw flat evidence of one camera, and a fault; and its table."""
    solution = solve_joint(pair, simulated(pair, frames=20))
    posterior = PosePosterior(0.1 * FLAT, FLAT, 0.3)
    evidence = Evidence(solution, pair, lambda *_: {CAMERA: posterior})
    checks = RunChecks(assess(evidence), {CAMERA: [FAILED]}, {CAMERA: [CAUSE]})
    table = solution.correspondences
    seen = table.with_metadata({**table.metadata, **to_metadata(evidence, checks)})
    return to_calibration(evidence, checks), seen


@pytest.fixture(scope="module")
def pair() -> Rig:
    return make_pair()


def test_covariance_and_verdict_of_the_saved_table_are_those_of_the_run(
    left_by_run: tuple[Calibration, Correspondences], tmp_path: Path, pair: Rig
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
    without = calibgraph.solve(pair, table.with_metadata({}))
    assert np.trace(without.covariance[CAMERA]) < 0.1 * np.trace(again.covariance[CAMERA])


@pytest.mark.parametrize(
    ("moved_m", "status", "words"),
    [(0.5, "FAIL", "its images exclude this pose"), (0.01, "WARN", "from this one")],
)
def test_what_images_said_of_another_pose_is_not_of_this_one(
    left_by_run: tuple[Calibration, Correspondences], moved_m: float, status: str, words: str
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


def test_what_images_said_with_another_lens_is_not_of_this_one(
    left_by_run: tuple[Calibration, Correspondences],
) -> None:
    made, table = left_by_run
    camera = made.rig.cameras[CAMERA]
    lens = camera.intrinsics_px.model_copy(update={"fx": 1.02 * camera.intrinsics_px.fx})
    cameras = {**made.rig.cameras, CAMERA: camera.model_copy(update={"intrinsics_px": lens})}
    found = calibgraph.solve(made.rig.model_copy(update={"cameras": cameras}), table)
    said = images_of(found, CAMERA)
    assert [check.status for check in said] == ["WARN"] and "another lens" in said[0].text
    assert "flat_evidence" not in [check.kind for check in found.camera_verdicts[CAMERA].checks]


def test_a_fault_of_one_camera_stays_where_another_has_moved(
    left_by_run: tuple[Calibration, Correspondences],
) -> None:
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
    left_by_run: tuple[Calibration, Correspondences], tolerance: tuple[float, float], kept: bool
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
def test_a_malformed_record_is_one_line(
    left_by_run: tuple[Calibration, Correspondences], path: str, value: object
) -> None:
    made, table = left_by_run
    record = table.metadata[IMAGES]
    cameras = dict(record["cameras"])
    posterior = {**cameras[CAMERA]["posterior"], path: value}
    cameras[CAMERA] = {**cameras[CAMERA], "posterior": posterior}
    wrong = table.with_metadata({**table.metadata, IMAGES: {"cameras": cameras}})
    with pytest.raises(CorrespondenceError, match=f"metadata '{IMAGES}': .*{path}"):
        calibgraph.solve(made.rig, wrong)
