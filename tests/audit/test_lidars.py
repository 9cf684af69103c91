"""LiDARs in `check` and `drift`: the one that moved is named, the base too, others are not."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import calibgraph
from calibgraph.arrays import Array
from calibgraph.audit import lidars as audit_of_lidars
from calibgraph.audit.lidars import measure_lidars
from calibgraph.errors import CalibrationError, RigError
from calibgraph.model.calibration import Calibration
from calibgraph.model.config import Config
from calibgraph.model.geometry import invert, transform, twist_between
from calibgraph.model.rig import Lidar, Rig
from calibgraph.model.verdict import TOLERANCE
from calibgraph.progress import no_progress
from calibgraph.vehicle.joined import joint_covariance
from calibgraph.vehicle.lidars import LidarPoses
from calibgraph.vehicle.rig import judge_lidar
from tests.conftest import Call
from tests.vehicle.scenes import MOUNTS
from tests.vehicle.test_rig import write_vehicle

SIGMAS = np.repeat([np.radians(0.02), 0.002], 3)
STEP = transform(Rotation.from_euler("z", 0.5, degrees=True), [0.0, 0.03, 0.0])
TIGHT = {"tolerance_deg": 0.2, "tolerance_cm": 2.0}


def poses_of(seed: int, moved: str = "") -> LidarPoses:
    """What a recording gives of LiDARs of which one was moved, or the base under all."""
    rng, others = np.random.default_rng(seed), [name for name in MOUNTS if name != "top"]
    T = {}
    for name, mount in MOUNTS.items():
        at = mount @ STEP if name == moved else mount
        if moved == "top" and name != "top":
            at = invert(STEP) @ mount
        turn, shift = np.split(SIGMAS * rng.normal(size=6), 2)
        R = Rotation.from_rotvec(turn).as_matrix() @ at[:3, :3]
        T[name] = np.eye(4) if name == "top" else transform(R, at[:3, 3] + shift)
    joint = np.diag(np.tile(SIGMAS**2, len(others)))
    return LidarPoses("top", T, joint, dict.fromkeys(MOUNTS, 1.0), 6, (1.0, 1.0))


def result_of(poses: LidarPoses) -> Calibration:
    lidars = {
        name: Lidar(T_base_lidar=T, covariance=poses.covariance.get(name))
        for name, T in poses.T_base_lidar.items()
    }
    rig = Rig(lidar="top", lidars={**lidars, "top": Lidar()})
    return Calibration(
        rig=rig, initial_rig=rig, covariance={}, joint_covariance=poses.joint_covariance,
        camera_verdicts={}, residuals={}, counts={}, timings_s={}, terms="full", config=Config(),
        lidar_verdicts={name: judge_lidar(poses, name, TOLERANCE) for name in poses.covariance},
    )  # fmt: skip


def measured(monkeypatch, poses: LidarPoses, deployed: Rig, tolerance: Array):
    """The audits of a recording that gives these poses."""
    verdicts = {name: judge_lidar(poses, name, TOLERANCE) for name in poses.covariance}
    found = SimpleNamespace(poses=poses, verdicts=verdicts)
    monkeypatch.setattr(audit_of_lidars, "find_lidars", lambda *_, **__: (None, found, ""))
    return measure_lidars(deployed, None, Config(), tolerance, progress=no_progress)[1]


@pytest.mark.parametrize("moved", ["", "front", "left"])
def test_the_lidar_that_moved_is_wrong_and_the_other_is_not(moved, monkeypatch):
    deployed = result_of(poses_of(1)).rig
    tolerance = np.array([np.radians(0.2), 0.02])
    found = measured(monkeypatch, poses_of(2, moved), deployed, tolerance)
    for name, audit in found.audits.items():
        assert audit.status == ("WRONG" if name == moved else "OK"), audit.reason
        wanted = np.concatenate([[0, 0, np.radians(0.5)], [0, 0.03, 0]]) * (name == moved)
        # of both results; in 12 numbers, 4 sigma
        assert (np.abs(audit.deviation - wanted) < 4 * np.sqrt(2) * SIGMAS).all()


def test_lidars_that_overlap_too_little_cannot_be_told_and_unknown_ones_are_refused(monkeypatch):
    deployed, tolerance = result_of(poses_of(1)).rig, np.array([0.01, 0.1])

    def fail(*_: object, **__: object) -> None:
        raise CalibrationError("LiDAR 'left' sees 3 planes")

    monkeypatch.setattr(audit_of_lidars, "find_lidars", fail)
    _, found = measure_lidars(deployed, None, Config(), tolerance, progress=no_progress)
    assert {of.status for of in found.audits.values()} == {"CANNOT TELL"}
    assert "sees 3 planes" in found.audits["left"].reason
    unknown = deployed.model_copy(update={"lidars": {**deployed.lidars, "left": Lidar()}})
    with pytest.raises(RigError, match=r"lidars.left: has no T_base_lidar"):
        measure_lidars(unknown, None, Config(), tolerance, progress=no_progress)


def test_deviations_of_cameras_and_lidars_have_one_covariance(monkeypatch):
    poses, by_lidars = poses_of(1), 1e-3 * np.random.default_rng(2).normal(size=(18, 12))
    lidars = {name: Lidar(T_base_lidar=T) for name, T in poses.T_base_lidar.items()}
    deployed = Rig(lidar="top", lidars={**lidars, "top": Lidar()})
    found = measured(monkeypatch, poses, deployed, np.array([0.01, 0.1]))
    columns = []  # deviations of what is deployed rightly, by one error of the poses each
    for column, root in zip(by_lidars.T, poses.root.T, strict=True):
        own = []
        for name, error in zip(poses.covariance, root.reshape(-1, 6), strict=True):
            T = poses.T_base_lidar[name]
            turned = Rotation.from_rotvec(error[:3]).as_matrix() @ T[:3, :3]
            truth = transform(turned, T[:3, 3] + error[3:])
            own.append(twist_between(invert(truth), invert(T)))
        columns.append(np.concatenate([column, *own]))  # T_camera_lidar = exp(xi) estimate
    of_cameras = by_lidars @ by_lidars.T
    joint = joint_covariance(of_cameras, -by_lidars, found.covariance, found.by_errors)
    expected = np.transpose(columns) @ columns
    sigmas = np.sqrt(np.diag(expected))
    # of turns of 0.02 deg, second orders are 3e-4
    assert np.abs((joint - expected) / np.outer(sigmas, sigmas)).max() < 1e-3


@pytest.mark.parametrize("moved", ["", "front", "top"])
def test_drift_names_the_lidar_that_moved_or_the_base(moved: str, tmp_path: Path, call: Call):
    results = {f"day{day}": result_of(poses_of(10 + day)) for day in range(4)}
    results["day4"] = result_of(poses_of(20, moved))
    found = calibgraph.drift(results, **TIGHT)
    named = {"": (), "front": (("day4", "front"),), "top": (("day4", "LiDAR"),)}[moved]
    assert found.changed == named
    folders = [of.save(tmp_path / day).parent for day, of in results.items()]
    code, _, err = call("drift", *folders, "--tolerance-deg", 0.2, "--tolerance-cm", 2)
    assert code == bool(moved), err
    if moved == "top":
        assert "CHANGED day4, base LiDAR" in err and "all other sensors agree on it" in err


def test_drift_refuses_results_of_other_lidars():
    other = result_of(poses_of(2))
    renamed = {"top": Lidar(), "rear": other.rig.lidars["left"], "front": other.rig.lidars["front"]}
    other = replace(
        other,
        rig=other.rig.model_copy(update={"lidars": renamed}),
        lidar_verdicts={name: other.lidar_verdicts["left"] for name in ("rear", "front")},
    )
    with pytest.raises(CalibrationError, match="has the LiDARs top, rear, front, "):
        calibgraph.drift([result_of(poses_of(1)), other])


def test_check_measures_lidars_in_a_recording(tmp_path: Path, call: Call):
    folder = write_vehicle(tmp_path / "data", seed=4, places=2, without="front")
    moved = Lidar(T_base_lidar=MOUNTS["left"] @ STEP @ STEP)
    path = tmp_path / "deployed.yaml"
    Rig(lidar="top", lidars={"top": Lidar(), "left": moved}).save(path)
    page = tmp_path / "page.html"
    code, out, err = call("check", path, folder, "--tolerance-deg", 0.4, "--tolerance-cm", 5,
                          "--out", page, "--json")  # fmt: skip
    assert code == 1, err
    left = json.loads(out)["lidars"]["left"]
    assert left["status"] == "WRONG" and "turned about z by -1.0" in left["reason"]
    assert "left is not where the calibration has it" in page.read_text()
