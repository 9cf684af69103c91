"""Cameras with the clouds of several LiDARs, and LiDARs that only cameras join."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

import calibgraph
from calibgraph import (
    Calibration,
    Correspondences,
    MatcherErrors,
    Rig,
    load_dataset,
    load_rig,
    simulate_correspondences,
)
from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError
from calibgraph.io.dataset import Dataset
from calibgraph.io.frame import Frame, ScanMotion, frame_of_entry
from calibgraph.matching.joined_clouds import errors_by_lidars, with_lidar_errors
from calibgraph.matching.named import find_matcher
from calibgraph.model.config import Config
from calibgraph.model.geometry import invert, move_points, retract_all, transform, twist_between
from calibgraph.model.rig import Lidar
from calibgraph.pipeline import find_lidars
from calibgraph.progress import no_progress
from calibgraph.vehicle.joined import (
    join_clouds,
    joint_covariance,
    lidar_errors,
    place_by_cameras,
)
from calibgraph.vehicle.lidars import LidarPoses
from calibgraph.vehicle.rig import LidarResult
from tests.conftest import SAMPLE, Call, make_pair

T_TOP_LOW = transform(Rotation.from_euler("ZYX", [70, 5, -3], degrees=True), [0.8, -0.4, -0.5])
SIGMAS = np.repeat([np.radians(0.03), 0.01], 3)
TOLERANCE = Config().tolerance


def poses_of(T: Array, sigmas: Array = SIGMAS) -> LidarPoses:
    return LidarPoses("top", {"top": np.eye(4), "low": T}, np.diag(sigmas**2), {}, 5, (1.0, 1.0))


def with_errors(data: Dataset, sigmas: Array = SIGMAS) -> Dataset:
    return replace(data, lidar_errors=lidar_errors(poses_of(T_TOP_LOW, sigmas)))


def moved(T: Array, error: Array) -> Array:
    """With a rotation [rad] and a shift of the position [m] along the axes of the base."""
    turn = Rotation.from_rotvec(error[:3]).as_matrix()
    return transform(turn @ T[:3, :3], T[:3, 3] + error[3:])


def write_cloud(path: Path, points: Array, intensity: float = 1.0) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, np.column_stack([points, np.full(len(points), intensity)]).astype(np.float32))
    return path


def test_a_joined_cloud_is_in_the_base_with_ranks_of_each_sensor(tmp_path: Path):
    base, other = np.array([[5.0, 1, 0], [6, 2, 0]]), np.array([[7.0, 0, 1], [8, 1, 1], [9, 2, 1]])
    paths = [
        write_cloud(tmp_path / name / "0.npy", of, 90.0)
        for name, of in zip("ab", (base, other), strict=True)
    ]
    frame = Frame(0, "0", paths[0], {}, lidar_paths={"low": paths[1]}, joined={"low": T_TOP_LOW})
    cloud = frame.load_cloud()
    np.testing.assert_allclose(cloud[:, :3], [*base, *move_points(other, T_TOP_LOW)], atol=1e-5)
    np.testing.assert_array_equal(cloud[:, 3], 0.5)
    again = frame_of_entry(frame.entry())
    np.testing.assert_array_equal(again.load_cloud(), cloud)


def test_where_the_vehicle_moves_only_timed_points_are_joined(tmp_path: Path):
    names = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4"), ("time", "f4")]
    points = np.array([(5.0, 0, 0, 1, 0.0), (5, 0, 0, 1, 0.1)], dtype=names)
    path = tmp_path / "low.npy"
    np.save(path, points)
    base = write_cloud(tmp_path / "1700000000000000000.npy", np.array([[4.0, 0, 0]]))
    motion = ScanMotion((0, 0, 0, 10.0, 0, 0), 0.0)
    frame = Frame(
        0, base.stem, base, {}, find_motion=lambda: motion, lidar_paths={"low": path},
        joined={"low": T_TOP_LOW},
    )  # fmt: skip
    first, later = frame.load_cloud()[1:, :3]
    np.testing.assert_allclose(later - first, [1.0, 0, 0], atol=1e-5)  # 10 m/s for 0.1 s
    untimed = write_cloud(tmp_path / "plain.npy", np.array([[5.0, 0, 0]]))
    assert len(replace(frame, lidar_paths={"low": untimed}).load_cloud()) == 1


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> tuple[Rig, Correspondences, Dataset]:
    """Matches of two cameras; of the left one half, of the right one all have points of ``low``."""
    folder, rig = tmp_path_factory.mktemp("joined"), make_pair()
    errors = MatcherErrors(noise_px=0.5, outlier_share=0.0)
    table = simulate_correspondences(rig, frames=3, matches=400, errors=errors)
    names, frames = [*table.cameras], []
    half = np.arange(len(table)) % 2 == 0
    of_low = half | (table.camera_index == names.index([*rig.cameras][1]))
    for number in range(3):
        own = table.frame == number
        base = write_cloud(folder / "top" / f"{number}.npy", table.points_lidar_m[own & ~of_low])
        low = move_points(table.points_lidar_m[own & of_low], invert(T_TOP_LOW))
        path = write_cloud(folder / "low" / f"{number}.npy", low)
        frames.append(
            Frame(
                number, str(number), base, {}, lidar_paths={"low": path}, joined={"low": T_TOP_LOW}
            )
        )
    return rig, table, Dataset(rig, tuple(frames), (folder,))


def test_errors_of_cameras_are_those_of_solving_with_a_wrong_lidar(
    drawn: tuple[Rig, Correspondences, Dataset],
):
    rig, table, data = drawn
    columns = errors_by_lidars(table, with_errors(data), rig)
    rng = np.random.default_rng(4)
    error = 0.1 * SIGMAS * rng.normal(size=6)
    wrong = moved(T_TOP_LOW, -error)  # the error is from the estimate to the truth
    low = np.array([of.load_in_base("low")[:, :3] for of in data.frames], dtype=object)
    points = table.points_lidar_m.copy()
    for number, cloud in enumerate(low):
        own = np.flatnonzero(table.frame == number)
        far = np.linalg.norm(points[own, None] - cloud[None].astype(float), axis=2).min(axis=1)
        at = own[far < 1e-3]
        points[at] = move_points(move_points(points[at], invert(T_TOP_LOW)), wrong)
    plain = calibgraph.solve(rig, table).rig
    solved = calibgraph.solve(rig, replace(table, points_lidar_m=points)).rig
    for name, camera in plain.cameras.items():
        expected = columns[name] @ (error / SIGMAS)
        found = twist_between(camera.T_camera_lidar, solved.cameras[name].T_camera_lidar)
        np.testing.assert_allclose(found, expected, atol=0.1 * np.abs(expected).max())
        assert np.abs(found).max() > 1e-5


def test_cameras_and_lidars_have_one_covariance(drawn: tuple[Rig, Correspondences, Dataset]):
    rig, table, data = drawn
    poses = poses_of(T_TOP_LOW)
    of_lidars = poses.joint_covariance, poses.root
    columns = np.concatenate([*errors_by_lidars(table, with_errors(data), rig).values()])
    joint = joint_covariance(columns @ columns.T + 1e-12 * np.eye(12), columns, *of_lidars)
    assert joint.shape == (18, 18)
    sigmas = np.sqrt(np.diag(joint))
    assert np.linalg.eigvalsh(joint / np.outer(sigmas, sigmas)).min() > -1e-9
    # With all its points of one LiDAR, a camera errs by nothing but that LiDAR's pose.
    np.testing.assert_allclose(joint[6:12, 12:] / SIGMAS, columns[6:], rtol=1e-6, atol=1e-12)
    alone = joint_covariance(np.eye(12), np.zeros((12, 0)), *of_lidars)
    np.testing.assert_array_equal(alone[:12, 12:], 0.0)


def test_solved_tables_keep_what_lidars_add(
    drawn: tuple[Rig, Correspondences, Dataset], tmp_path: Path
):
    rig, table, data = drawn
    data = with_errors(data, 3 * SIGMAS)
    columns, known = errors_by_lidars(table, data, rig), with_lidar_errors(table, data, rig)
    path = tmp_path / "table.parquet"
    known.save(path)
    plain, wider = calibgraph.solve(rig, table), calibgraph.solve(rig, path)
    for name, of in columns.items():
        added = wider.covariance[name] - plain.covariance[name]
        np.testing.assert_allclose(added, of @ of.T, atol=1e-6 * np.abs(of).max() ** 2)
        assert "poses of other LiDARs" in wider.error_sources[name].rotation


def calibrations(done: Calibration, T: Sequence[Array], errors: Array) -> list[Calibration]:
    """Of all cameras to the base, and to another LiDAR; with errors (2, N, 6) of variance one."""
    rig, found = done.initial_rig, []
    for own, error in zip(T, errors, strict=True):
        at = {n: c.T_camera_lidar @ own for n, c in rig.cameras.items()}
        off = retract_all(np.array([*at.values()]), 1e-3 * error)
        found.append(
            replace(
                done,
                rig=rig.moved_to(dict(zip(at, off, strict=True))),
                joint_covariance=1e-6 * np.eye(6 * len(at)),
            )
        )
    return found


def _next(of: Iterator[Calibration], *_: object) -> Calibration:
    return next(of)


def test_cameras_place_a_lidar_with_the_error_bar_of_both_sides():
    rig, rng, squares = load_rig(SAMPLE / "reference.yaml"), np.random.default_rng(0), list[float]()
    rig = rig.model_copy(update={
        "lidar": "top", "lidars": {"top": Lidar(), "low": Lidar(T_base_lidar=T_TOP_LOW)}
    })  # fmt: skip
    data = load_dataset(SAMPLE)
    frames = tuple(replace(f, lidar_paths={"low": f.cloud_path}) for f in data.frames)
    data = replace(data, frames=frames)
    at = rig.model_copy(update={"lidars": None})
    seen = Rig(cameras={n: at.cameras[n] for n in [*at.cameras][:2]})
    done = calibgraph.solve(seen, simulate_correspondences(seen, frames=6, matches=60, errors=None))
    ready = [
        calibrations(done, [np.eye(4), T_TOP_LOW], rng.normal(size=(2, 2, 6))) for _ in range(40)
    ]
    for of in map(iter, ready):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("calibgraph.vehicle.joined._cameras_in", lambda *_: [*seen.cameras])
            poses = place_by_cameras(partial(_next, of), data, rig, "low")
        T = poses.T_base_lidar["low"]
        turn = Rotation.from_matrix(T_TOP_LOW[:3, :3] @ T[:3, :3].T).as_rotvec()
        off = np.append(turn, T_TOP_LOW[:3, 3] - T[:3, 3])
        squares.append(float(off @ np.linalg.solve(poses.covariance["low"], off)) / 6)
    # The mean of 40 has a standard deviation of 0.09; scatter beyond the bars makes bars wider.
    assert 0.6 < np.mean(squares) < 1.3


def test_a_lidar_that_no_camera_sees_is_not_placed():
    rig = load_rig(SAMPLE / "reference.yaml")
    behind = transform(Rotation.from_euler("z", 180, degrees=True), [0.0, 0.0, 0.0])
    rig = rig.model_copy(update={
        "lidar": "top", "lidars": {"top": Lidar(), "low": Lidar(T_base_lidar=behind)}
    })  # fmt: skip
    data = load_dataset(SAMPLE)
    data = replace(
        data, frames=tuple(replace(f, lidar_paths={"low": f.cloud_path}) for f in data.frames)
    )
    with pytest.raises(
        CalibrationError, match="top and low share no planes, and no camera sees what both see"
    ):
        place_by_cameras(lambda *_: pytest.fail("calibrates"), data, rig, "low")


def split_sample(folder: Path, upto_deg: float, from_deg: float) -> Dataset:
    """The sample, its cloud divided among two LiDARs by heading."""
    data, T = load_dataset(SAMPLE), T_TOP_LOW
    for frame in data.frames:
        cloud = frame.load_cloud()
        heading = np.degrees(np.arctan2(cloud[:, 1], cloud[:, 0]))
        for name, own in (("top", heading < upto_deg), ("low", heading > from_deg)):
            of = cloud[own].copy()
            if name == "low":
                of[:, :3] = move_points(of[:, :3].astype(float), invert(T))
            path = folder / "lidars" / name / f"{frame.name}.npy"
            path.parent.mkdir(parents=True, exist_ok=True)
            np.save(path, of)
    (folder / "cameras").symlink_to(SAMPLE / "cameras")
    content = yaml.safe_load((SAMPLE / "rig.yaml").read_text())
    guess = moved(T, np.array([0.02, -0.01, 0.03, 0.1, -0.05, 0.05]))
    content |= {"lidar": "top", "lidars": {"top": {}, "low": {"T_base_lidar": guess.tolist()}}}
    (folder / "rig.yaml").write_text(yaml.safe_dump(content))
    return load_dataset(folder)


@pytest.mark.slow
@pytest.mark.parametrize(("upto_deg", "from_deg"), [(75.0, -15.0), (10.0, 10.0)])
def test_cameras_that_the_base_does_not_show_are_calibrated_to_all_lidars(
    upto_deg: float, from_deg: float, tmp_path: Path, call: Call
):
    result = calibgraph.calibrate(split_sample(tmp_path, upto_deg, from_deg))
    truth = load_rig(SAMPLE / "reference.yaml")
    line = next(line for line in result.warnings if "joined for cameras" in line)
    assert "left" in line
    if from_deg >= upto_deg:
        assert any("placed by cameras" in line for line in result.warnings)
    for name, camera in result.rig.cameras.items():
        away = twist_between(camera.T_camera_lidar, truth.cameras[name].T_camera_lidar)
        sigmas = np.sqrt(np.diag(result.covariance[name]))
        assert np.abs(away / sigmas).max() < 4
        assert np.degrees(np.abs(away[:3]).max()) < 0.3
    off = result.T_base_lidar["low"][:3, 3] - T_TOP_LOW[:3, 3]
    assert np.abs(off / np.sqrt(np.diag(result.rig.lidars["low"].covariance))[3:]).max() < 4
    n = len(result.joint_covariance) - 6
    assert np.abs(result.joint_covariance[:n, n:]).max() > 0
    path = result.save(tmp_path / "out")
    again = calibgraph.load_calibration(path)
    assert frame_of_entry(again.frames[0]).joined.keys() == {"low"}
    audit = calibgraph.check(path, tmp_path)
    assert {of.status for of in audit.cameras.values()} == {"OK"}
    low = audit.lidars["low"]
    assert np.abs(low.deviation / low.sigma).max() < 4
    # placed by one camera its bar is wider than the tolerance
    assert low.status == ("OK" if from_deg < upto_deg else "CANNOT TELL")
    if from_deg < upto_deg:
        code, _, err = call("match", tmp_path, "--out", tmp_path / "table.parquet")
        table = calibgraph.load_correspondences(tmp_path / "table.parquet")
        assert code == 0, err
        assert table.findings.by_lidars.keys() == {*truth.cameras}
        assert table.counts() == result.correspondences.counts()


def test_tables_place_no_lidar_and_join_no_clouds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Their points are of one LiDAR: both sides would be the same."""
    data = split_sample(tmp_path, 10.0, 10.0)
    table, asked = simulate_correspondences(data.rig, frames=6, matches=50), []

    def found(*_: object, place: object, **__: object) -> LidarResult:
        asked.append(place)
        return LidarResult(None, poses_of(T_TOP_LOW), {}, ())

    monkeypatch.setattr("calibgraph.pipeline.calibrate_rig_lidars", found)
    table.save(tmp_path / "table.parquet")
    for matcher in (tmp_path / "table.parquet", table, find_matcher(table)):
        same, _, joined = find_lidars(data, data.rig, matcher, Config(), progress=no_progress)
        assert same is data and joined == ""
    assert asked == [None, None, None]


def test_clouds_are_joined_only_where_cameras_gain(tmp_path: Path):
    data = split_sample(tmp_path, 60.0, 10.0)
    joined, line = join_clouds(data, data.rig, poses_of(T_TOP_LOW), TOLERANCE)
    assert "left" in line and all(frame.joined for frame in joined.frames)
    unsure = poses_of(T_TOP_LOW, 20 * SIGMAS)
    assert join_clouds(data, data.rig, unsure, TOLERANCE) == (data, "")
    ahead = Rig(cameras={n: c for n, c in data.rig.cameras.items() if n != "left"})
    assert join_clouds(data, ahead, poses_of(T_TOP_LOW), TOLERANCE) == (data, "")
