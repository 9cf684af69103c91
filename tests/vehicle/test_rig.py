"""A rig of several LiDARs: its file, the command, the result that is written, and exports."""

import io
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from rich.console import Console
from scipy.spatial.transform import Rotation

import calibgraph
from calibgraph.errors import DatasetError, FileError, RigError
from calibgraph.io.formats.export import export_calibration
from calibgraph.io.rigs import load_rig
from calibgraph.model.calibration import Calibration
from calibgraph.model.geometry import transform
from calibgraph.report.html import render_page
from calibgraph.report.tables import print_result
from calibgraph.vehicle import start
from tests.conftest import SAMPLE, Call, require_poses
from tests.vehicle.scenes import HEIGHT_M, MOUNTS, displaced, draw_place, record, scan

pytestmark = pytest.mark.usefixtures("few_placements")

RIG = {"format": "calibgraph-rig/1", "lidar": "top", "lidars": {name: {} for name in MOUNTS}}


AZIMUTHS_DEG = np.arange(-180.0, 180.0, 2.0)
SAMPLE_RIG = (SAMPLE / "rig.yaml").read_text()


def write_vehicle(
    folder: Path, seed: int = 1, places: int = 3, without: str = "", **more: object
) -> Path:
    mounts = {name: T for name, T in MOUNTS.items() if name != without}
    for name, clouds in record(seed, places=places, mounts=mounts, beams=12).items():
        (folder / "lidars" / name).mkdir(parents=True)
        for number, cloud in enumerate(clouds):
            of = np.column_stack([cloud, np.ones(len(cloud))]).astype(np.float32)
            np.save(folder / "lidars" / name / f"{number:06d}.npy", of)
    content = {**RIG, "lidars": {name: {} for name in mounts}, **more}
    (folder / "rig.yaml").write_text(yaml.safe_dump(content))
    return folder


@pytest.fixture(scope="module")
def vehicle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    known = {
        "T_vehicle_lidar": transform(np.eye(3), [1.0, 0.0, 1.7]).tolist(),
        "rotation_sigma_rad": 0.02, "translation_sigma_m": [0.01, 0.01, 0.3],
    }  # fmt: skip
    guesses = {
        name: {} if name == "top" else {"T_base_lidar": displaced(T, 1, 5.0, 0.1).tolist()}
        for name, T in MOUNTS.items()
    }
    return write_vehicle(tmp_path_factory.mktemp("vehicle"), vehicle=known, lidars=guesses)


@pytest.fixture(scope="module")
def result(vehicle: Path) -> Calibration:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(start, "_TRIED", 2)  # placements: that of the guess, and another one
        return calibgraph.calibrate(vehicle)


def test_every_lidar_has_a_pose_a_sigma_and_a_verdict(result: Calibration):
    for name in ("front", "left"):
        off = result.T_base_lidar[name][:3, 3] - MOUNTS[name][:3, 3]
        degrees, centimetres = result.sigmas(name)
        assert np.abs(off).max() < 0.004 and centimetres.max() < 1.5 and degrees.max() < 0.1
    assert {name: of.status for name, of in result.verdicts.items()} == {
        "front": "PASS", "left": "PASS"
    }  # fmt: skip
    assert result.verdict.status == "PASS"
    assert result.joint_names == ("front", "left")
    assert result.joint_covariance.shape == (12, 12)
    assert np.isclose(result.T_vehicle_lidar[2, 3], 1.8, atol=0.02), "over the road, not as typed"
    assert np.isfinite(result.vehicle_sigmas).all()


def test_a_result_is_read_as_it_was_written(result: Calibration, tmp_path: Path):
    path = result.save(tmp_path / "out")
    again = calibgraph.load_calibration(path)
    assert again.verdicts == result.verdicts
    np.testing.assert_allclose(again.joint_covariance, result.joint_covariance)
    for name, T in result.T_base_lidar.items():
        np.testing.assert_array_equal(again.T_base_lidar[name], T)
        np.testing.assert_array_equal(load_rig(path).T_base_lidar[name], T)
    np.testing.assert_array_equal(again.vehicle_sigmas, result.vehicle_sigmas)
    content = yaml.safe_load(path.read_text())
    content["lidar_verdicts"]["left"]["status"] = "WARN"
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(FileError, match="verdict WARN of LiDAR 'left', its checks give PASS"):
        calibgraph.load_calibration(path)


def test_a_lidar_that_measures_too_long_is_placed_where_it_is_and_named(tmp_path: Path):
    folder = write_vehicle(tmp_path, without="left")
    for path in (folder / "lidars" / "front").iterdir():
        cloud = np.load(path)
        ranges = np.linalg.norm(cloud[:, :3], axis=1, keepdims=True)
        cloud[:, :3] *= 1.0 + 0.02 / ranges
        np.save(path, cloud)
    result = calibgraph.calibrate(folder)
    off = result.T_base_lidar["front"][:3, 3] - MOUNTS["front"][:3, 3]
    assert np.linalg.norm(off) < 0.004, "2 cm off by the clouds as they are"
    line = next(each for each in result.warnings if each.startswith("front measures"))
    assert re.match(r"front measures (1\.[89]|2\.[0-2]) cm longer ranges than top:", line)


def test_clouds_in_millimetres_are_refused(tmp_path: Path):
    write_vehicle(tmp_path, places=1, without="front")
    for path in (tmp_path / "lidars" / "left").iterdir():
        np.save(path, 1000.0 * np.load(path))
    with pytest.raises(DatasetError, match="LiDAR 'left' are farther than .* in metres"):
        calibgraph.calibrate(tmp_path)


def test_clouds_of_a_drive_that_are_a_frame_late_are_no_pass(tmp_path: Path):
    rng, boxes, step = np.random.default_rng(3), draw_place(np.random.default_rng(1)), 0.2
    for name, late in (("top", 0.0), ("left", 1.0)):
        (tmp_path / "lidars" / name).mkdir(parents=True)
        for number in range(2):
            at = transform(np.eye(3), [step * (number - late), 0.0, HEIGHT_M])
            cloud = scan(boxes, at @ MOUNTS[name], rng, beams=12, azimuths_deg=AZIMUTHS_DEG)
            np.save(tmp_path / "lidars" / name / f"{number}.npy", cloud)
    guess = {"T_base_lidar": MOUNTS["left"].tolist()}
    (tmp_path / "rig.yaml").write_text(
        yaml.safe_dump({**RIG, "lidars": {"top": {}, "left": guess}})
    )
    found = calibgraph.calibrate(tmp_path)
    off = found.T_base_lidar["left"][0, 3] - MOUNTS["left"][0, 3]
    assert abs(off) > 0.15, "the way of a frame"
    assert found.sigmas("left")[1][0] > 100.0 * step / 2.5 and found.verdict.status == "WARN"
    assert "moves by 20 cm from one cloud to the next" in found.warnings[0]
    stated = calibgraph.calibrate(tmp_path, config=calibgraph.Config(instant_clouds=True))
    assert stated.sigmas("left")[1][0] < 5.0 and not stated.warnings


def test_the_report_has_a_table_of_lidars(result: Calibration):
    page = render_page(result)
    assert "Can this calibration of 2 LiDARs to the LiDAR top be used?" in page
    assert (
        "T_base_lidar of left" in page
        and "top in base_link" in page
        and "All LiDARs" in page
        and "All cameras" not in page
        and 'alt="Clouds of LiDARs from above, after"' in page
    )


def test_clouds_that_are_gone_leave_their_pictures_out_of_the_report(result: Calibration):
    gone = [
        {**entry, "lidars": dict.fromkeys(entry["lidars"], "gone.npy")} for entry in result.frames
    ]
    page = render_page(replace(result, frames=tuple(gone)))
    assert "Pictures of clouds are left out:</b> gone.npy: no such file" in page


def test_the_command_prints_all_lidars_and_names_one_that_does_not_fit_its_guess(
    tmp_path: Path, call: Call
):
    in_mm = MOUNTS["left"].copy()
    in_mm[:3, 3] *= 1000.0
    lidars = {"top": {}, "left": {"T_base_lidar": in_mm.tolist()}}
    folder = write_vehicle(tmp_path / "data", seed=2, places=1, without="front", lidars=lidars)
    code, out, err = call("calibrate", folder, "--out", tmp_path / "out", "--json")
    assert code == 0, err
    printed = json.loads(out)
    assert printed["cameras"] == {} and [*printed["lidars"]] == ["left"]
    assert printed["verdict"] == "WARN" and printed["cannot_tell"], "one instant is too few"
    found = calibgraph.load_calibration(tmp_path / "out")
    assert np.abs(found.T_base_lidar["left"] - MOUNTS["left"]).max() < 0.01
    assert not found.warnings
    print_result(Console(file=(text := io.StringIO()), width=80), found, [], 1.0)
    assert "LiDARs in top" in text.getvalue()
    assert "cannot tell: instants: 1, below the limit 3" in text.getvalue()
    assert "it does not fit its guess, but turned by 0 deg and moved by 1" in " ".join(
        found.verdicts["left"].reasons
    )


def test_transforms_of_lidars_and_vehicle_are_exported(result: Calibration, tmp_path: Path):
    kit = tmp_path / "sensor_kit_calibration.yaml"
    written = export_calibration(result, kit, "autoware")
    assert [path.name for path in written] == [kit.name, "sensors_calibration.yaml"]
    links = yaml.safe_load(kit.read_text())["sensor_kit_base_link"]
    assert [*links] == ["top", "front", "left"]
    assert np.allclose([links["left"][k] for k in "xyz"], result.T_base_lidar["left"][:3, 3])
    kit_in_vehicle = yaml.safe_load(written[1].read_text())["base_link"]["sensor_kit_base_link"]
    assert np.allclose([kit_in_vehicle[k] for k in "xyz"], result.T_vehicle_lidar[:3, 3])
    urdf = export_calibration(result, tmp_path / "rig.urdf", "urdf")[0].read_text()
    assert '<parent link="top" />' in urdf and '<child link="left" />' in urdf
    assert '<parent link="base_link" />' in urdf
    launch = export_calibration(result, tmp_path / "rig.launch.xml", "ros2-launch")[0].read_text()
    assert launch.count("<node") == 3
    assert json.loads(export_calibration(result, tmp_path / "r.json", "json")[0].read_text())[
        "lidars"
    ]
    with pytest.raises(RigError, match="no camera, only LiDARs"):
        export_calibration(result, tmp_path / "camchain.yaml", "kalibr")


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (None, "its roll, pitch, yaw, x, y, z are unknown"),
        ({"T_vehicle_lidar": None}, "its roll, pitch, yaw, x, y, z are unknown"),
        ({"translation_sigma_m": (np.inf, 0.1, 0.1)}, "top in base_link is left out, as its x are"),
    ],
)
@pytest.mark.parametrize("format", ["autoware", "urdf"])
def test_a_pose_in_the_vehicle_that_is_not_written_is_named(
    format: str, change: dict | None, named: str, result: Calibration, tmp_path: Path, call: Call
):
    vehicle = None if change is None else result.rig.vehicle.model_copy(update=change)
    folder = tmp_path / "out"
    replace(result, rig=result.rig.model_copy(update={"vehicle": vehicle})).save(folder)
    code, _, err = call("export", folder, "--format", format, "--out", tmp_path / "kit")
    assert code == 0 and named in err and not (tmp_path / "sensors_calibration.yaml").exists()
    assert ("sensors_calibration.yaml is not written" in err) == (format == "autoware")


def test_of_a_deployed_kit_only_calibrated_rows_change(
    result: Calibration, tmp_path: Path, call: Call
):
    folder, kit = result.save(tmp_path / "out").parent, tmp_path / "kit.yaml"
    row = dict.fromkeys(("x", "y", "z", "roll", "pitch", "yaw"), 0.0)
    rows = {"top": {**row, "z": 1.0, "yaw": 1.5}, "imu": {**row, "x": 0.7}, "front": row}
    words = ["export", folder, "--format", "autoware", "--out", kit, "--deployed", kit, "--force"]
    for deployed, named in (
        ({"sensor_kit_base_link": rows}, "kit.yaml: has no row left, only front, imu, top: name"),
        ({"sensor_kit_base_link": {"top": {"x": 1}}}, "kit_base_link: top: expected the keys x, y"),
        ({"base_link": rows}, "kit.yaml: has no rows of sensor_kit_base_link; name the"),
    ):
        kit.write_text(yaml.safe_dump(deployed))
        code, _, err = call(*words)
        assert code == 2 and named in err
    kit.write_text(yaml.safe_dump({"sensor_kit_base_link": {**rows, "left": row}}))
    code, _, err = call(*words)
    assert code == 0 and "imu: turned by 0.000 deg, moved by 0.00 cm" in err
    written = yaml.safe_load(kit.read_text())["sensor_kit_base_link"]
    assert written["imu"] == rows["imu"] and np.isclose(written["top"]["yaw"], 1.5)
    T_kit_base = transform(Rotation.from_euler("z", 1.5), [0.0, 0.0, 1.0])
    wanted = (T_kit_base @ result.T_base_lidar["left"])[:3, 3]
    assert np.allclose([written["left"][key] for key in "xyz"], wanted)
    assert f"moved by {100 * np.linalg.norm(wanted):.2f} cm" in err


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lidars": None}, "cameras: the rig has none; name one, or at least two lidars"),
        ({"lidars": {"top": {}}}, "name one, or at least two lidars"),
        ({"lidar": "roof"}, "the base 'roof' is none of the lidars front, left, top"),
        ({"lidars": {**RIG["lidars"], "top": {"T_base_lidar": MOUNTS["left"].tolist()}}},
         "lidars.top.T_base_lidar: of the base it is the identity"),
        ({"lidars": {"top": {}, "left": {"T_lidar_base": 1}}}, "unknown key 'lidars.left.T_lidar"),
        (
            {"lidars": None, "vehicle": {}, "cameras": yaml.safe_load(SAMPLE_RIG)["cameras"],
             "lidar": "lidar"},
            "vehicle: is found with several lidars",
        ),
        ({"vehicle": {"rotation_sigma_rad": [1, 2]}}, "vehicle.rotation_sigma_rad"),
        ({"vehicle": {"translation_sigma_m": -1}}, "vehicle.translation_sigma_m"),
    ],
)  # fmt: skip
def test_a_wrong_rig_is_refused_in_one_line(change: dict, message: str, tmp_path: Path):
    path = tmp_path / "rig.yaml"
    path.write_text(yaml.safe_dump({**RIG, **change}))
    with pytest.raises(FileError, match=message) as caught:
        load_rig(path)
    assert "\n" not in str(caught.value)


def test_instants_without_all_clouds_are_left_out_and_named(vehicle: Path, tmp_path: Path):
    folder = write_vehicle(tmp_path, places=1)
    (folder / "lidars" / "left" / "000000.npy").rename(folder / "lidars" / "left" / "1.npy")
    with pytest.raises(DatasetError, match="of 1 of top, front has 1, left has 0; clouds of one"):
        calibgraph.calibrate(folder)
    with pytest.raises(FileError, match=r"lidars.right: no such folder"):
        calibgraph.calibrate(vehicle, load_rig(vehicle).model_copy(update={
            "lidars": {**load_rig(vehicle).lidars, "right": load_rig(vehicle).lidars["left"]}
        }))  # fmt: skip


@pytest.mark.parametrize("command", ["match", "evaluate"])
def test_commands_for_cameras_refuse_a_rig_of_lidars_alone(
    command: str, vehicle: Path, result: Calibration, tmp_path: Path, call: Call
):
    other = replace(result, inputs={"another": "0" * 64})
    saved = [of.save(tmp_path / str(n)).parent for n, of in enumerate((result, other))]
    unread = shutil.copytree(vehicle, tmp_path / "data")
    for cloud in unread.rglob("*.npy"):
        cloud.write_bytes(b"")
    words = {"match": [unread, "--out", tmp_path / "m.parquet"], "evaluate": saved}
    code, out, err = call(command, *words[command])
    assert (code, out) == (2, "") and "no camera, only LiDARs (front, left, top)" in err


def test_a_bag_has_a_topic_of_clouds_per_lidar(tmp_path: Path):
    writing = pytest.importorskip("tests.io.bags.writing")
    make, clouds, messages = writing.Messages("mcap"), record(3, places=2), []
    for name, of in clouds.items():
        for number, cloud in enumerate(of):
            late_ns = {"top": 0, "front": 4_000_000, "left": -7_000_000}[name]
            stamp_ns = writing.START_NS + number * writing.PERIOD_NS + late_ns
            points = writing.structured(np.column_stack([cloud, np.ones(len(cloud))]))
            topic = f"/sensing/{name}/points"
            content = make.cloud(points, stamp_ns)
            kind = "sensor_msgs/msg/PointCloud2"
            messages.append(writing.Stamped(topic, kind, stamp_ns, content))
    bag = writing.write_bag(tmp_path, "mcap", sorted(messages, key=lambda each: each.record_ns))
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(RIG))
    rig = load_rig(tmp_path / "rig.yaml")
    data = calibgraph.load_dataset(bag, rig)
    assert "2 clouds, 2 with all clouds of other LiDARs within 0.05 s" in " ".join(data.notes)
    for number, frame in enumerate(data.frames):
        for name, of in clouds.items():
            found, _ = frame.load_recorded(name, timed=False)
            np.testing.assert_array_equal(found[:, :3], of[number].astype(np.float32))
    with pytest.raises(DatasetError, match=r"LiDAR 'roof'\? .*--topic roof=/TOPIC"):
        lidars = {"top": rig.lidars["top"], "roof": rig.lidars["left"]}
        calibgraph.load_dataset(bag, rig.model_copy(update={"lidars": lidars}))
    moving = calibgraph.load_dataset(bag, rig, bag=calibgraph.BagOptions(motion="scans"))
    assert all(frame.find_motion for frame in moving.frames)


@pytest.mark.slow
def test_cameras_and_lidars_are_one_result(tmp_path: Path):
    T, rng = MOUNTS["left"], np.random.default_rng(0)
    for frame in calibgraph.load_dataset(SAMPLE).frames:
        cloud = frame.load_cloud()
        other = cloud[rng.random(len(cloud)) < 0.7].copy()
        other[:, :3] = (other[:, :3] - T[:3, 3]) @ T[:3, :3] + rng.normal(0, 0.01, (len(other), 3))
        for name, points in (("lidar", cloud), ("second", other)):
            (tmp_path / "lidars" / name).mkdir(parents=True, exist_ok=True)
            np.save(tmp_path / "lidars" / name / frame.cloud_path.stem, points)
    shutil.copytree(SAMPLE / "cameras", tmp_path / "cameras")
    rig = {**yaml.safe_load(SAMPLE_RIG), "lidars": {"lidar": {}, "second": {}}}
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(rig))
    both, alone = calibgraph.calibrate(tmp_path), calibgraph.calibrate(SAMPLE)
    assert both.joint_names == (*alone.rig.cameras, "second")
    cameras = 6 * len(alone.rig.cameras)
    np.testing.assert_array_equal(
        both.joint_covariance[:cameras, :cameras], alone.joint_covariance
    )  # cameras are calibrated to the base as without the other LiDAR
    require_poses(both.T_camera_lidar, alone.T_camera_lidar, atol=0)
    assert np.abs(both.T_base_lidar["second"] - T).max() < 0.005
