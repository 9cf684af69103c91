"""Lenses and clocks of cameras: how well they are known, and what an offset does."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from calibgraph import (
    Camera,
    Config,
    Correspondences,
    Dataset,
    Intrinsics,
    Rig,
    dataset_from_arrays,
    evaluate,
    export_calibration,
    import_rig,
    load_correspondences,
    load_dataset,
    load_rig,
    rounds,
)
from calibgraph.errors import CalibrationError, MotionError
from calibgraph.graph.lens import LensVariable
from calibgraph.matching.run import with_delays, with_motion
from calibgraph.model.clock import at_pixels, seen_at_rows, when_taken
from calibgraph.model.correspondences import concatenate
from calibgraph.model.lens import IN_DOUBT, LensSigmas, state_calibrated
from calibgraph.model.places import Places
from calibgraph.simulation.rigs import rig_of
from tests.conftest import make_camera, make_pair

TWISTS = np.array([[0.01, 0.02, 0.3, 8.0, 0.1, 0.0], [0.0, 0.0, -0.2, 12.0, 0.0, 0.1]])


def rig_with(**times: float) -> Rig:
    rig = rig_of("kitti")
    cameras = {name: camera.model_copy(update=times) for name, camera in rig.cameras.items()}
    return rig.model_copy(update={"cameras": cameras})


def rows(twists: np.ndarray | None = TWISTS) -> Correspondences:
    return Correspondences.from_arrays(
        camera="image_2",
        frame=[0, 1],
        pixels_px=[[100.0, 50.0], [900.0, 300.0]],
        points_lidar_m=[[12.0, 3.0, -1.0], [20.0, -4.0, 0.5]],
        twist_per_s=twists,
    )


def test_points_at_a_late_image_are_seen_as_by_a_camera_that_moved_on() -> None:
    camera, table = rig_with(time_offset_s=0.05).cameras["image_2"], rows()
    moved = at_pixels(camera, table).points_lidar_m
    for point, later, twist in zip(table.points_lidar_m, moved, TWISTS, strict=True):
        there = when_taken(camera, twist).T_camera_lidar
        here = camera.T_camera_lidar
        np.testing.assert_allclose(
            there[:3, :3] @ point + there[:3, 3], here[:3, :3] @ later + here[:3, 3], atol=1e-12
        )
        # 5 cm of the 10 m/s or so, and the turn; to second order 0.05^2 0.3 12 / 2 = 5 mm.
        first_order = point - 0.05 * (twist[3:] + np.cross(twist[:3], point))
        np.testing.assert_allclose(later, first_order, atol=0.01)


def test_rows_below_the_middle_are_taken_later() -> None:
    camera, table = rig_with(readout_s=0.04).cameras["image_2"], rows(TWISTS[[1, 1]])
    moved = at_pixels(camera, table).points_lidar_m - table.points_lidar_m
    assert moved[0, 0] > 0 > moved[1, 0]  # ahead: a later point is nearer


def test_points_of_a_rolling_shutter_are_seen_at_their_rows() -> None:
    """To a tenth of a pixel where a table with the pixels has them."""
    camera = rig_with(readout_s=0.04).cameras["image_2"]
    points = np.array([[6.0, 2.0, -1.2], [12.0, -3.0, 1.5], [8.0, 0.5, 0.0]])
    twist, T = TWISTS[0], camera.T_camera_lidar
    seen = seen_at_rows(camera, np.repeat(points[:, None], 2, axis=1), twist)
    np.testing.assert_array_equal(seen[:, 0], seen[:, 1])
    pixels, _ = camera.lens.project(seen[:, 0] @ T[:3, :3].T + T[:3, 3])
    table = Correspondences.from_arrays(
        camera="image_2", frame=[0, 0, 0], pixels_px=pixels, points_lidar_m=points,
        twist_per_s=np.tile(twist, (3, 1)),
    )  # fmt: skip
    there = at_pixels(camera, table).points_lidar_m
    expected, _ = camera.lens.project(there @ T[:3, :3].T + T[:3, 3])
    still, _ = camera.lens.project(points @ T[:3, :3].T + T[:3, 3])
    assert np.abs(expected - still).max() > 4.0
    np.testing.assert_allclose(pixels, expected, atol=0.1)
    assert seen_at_rows(camera, points[:, None], None).shape == (3, 1, 3)


@pytest.mark.parametrize("name", ["table.parquet", "table.csv"])
def test_motion_is_kept_in_tables(tmp_path: Path, name: str) -> None:
    replace(rows(), late_s=np.array([0.03, -0.02])).save(tmp_path / name)
    read = load_correspondences(tmp_path / name)
    np.testing.assert_array_equal(read.twist_per_s, TWISTS)
    np.testing.assert_array_equal(read.late_s, [0.03, -0.02])
    joined = concatenate([read, rows()])  # points of one instant are as late as their pixels
    np.testing.assert_array_equal(joined.late_s, [0.03, -0.02, 0.0, 0.0])
    with pytest.raises(CalibrationError, match="late_s must be below 10 s"):
        replace(rows(), late_s=np.array([np.nan, 0.0]))


def test_points_of_a_sweep_are_moved_to_their_pixels() -> None:
    """What a late point and an early pixel do to each other is their difference in time."""
    camera, swept = rig_of("kitti").cameras["image_2"], replace(rows(), late_s=np.full(2, 0.05))
    moved = at_pixels(camera, swept).points_lidar_m
    earlier = rig_with(time_offset_s=-0.05).cameras["image_2"]
    np.testing.assert_allclose(moved, at_pixels(earlier, rows()).points_lidar_m, atol=1e-12)
    unknown = replace(swept, twist_per_s=None)
    np.testing.assert_array_equal(at_pixels(camera, unknown).points_lidar_m, rows().points_lidar_m)


def sweep(folder: Path, names: list[str], images: dict[str, list[str]], **times: object) -> Dataset:
    """A folder with clouds whose points have times, and black images."""
    rig = rig_of("kitti")
    for name in names:
        (folder / "lidar").mkdir(parents=True, exist_ok=True)
        cloud = np.zeros(2, [(axis, "f8") for axis in "xyz"] + [("t", "f8")])
        for axis, column in zip("xyz", rows().points_lidar_m.T, strict=True):
            cloud[axis] = column
        cloud["t"] = times.get(name, [0.0, 0.1])
        np.save(folder / "lidar" / f"{name}.npy", cloud)
    for camera, lens in rig.cameras.items():
        (folder / "cameras" / camera).mkdir(parents=True, exist_ok=True)
        for name in images.get(camera, names):
            image = np.zeros((lens.height_px, lens.width_px), np.uint8)
            cv2.imwrite(str(folder / "cameras" / camera / f"{name}.png"), image)
    return load_dataset(folder, rig)


STAMPS = ["1700000000.000000000", "1700000001.000000000"]
TRIGGERED = ["1700000000.040000000", "1700000001.040000000"]


@pytest.mark.parametrize(
    ("names", "images", "times", "late_s"),
    [
        (["0", "1"], {}, [0.0, 0.1], [-0.05, 0.05]),  # images in the middle of the sweep
        (["0", "1"], {}, [1.7e9, 1.7e9 + 0.1], [-0.05, 0.05]),  # stamps
        (STAMPS, {}, [0.0, 0.1], [0.0, 0.1]),  # at the clouds' stamps
        (STAMPS, {"image_2": TRIGGERED}, [0.0, 0.1], [-0.04, 0.06]),
        (STAMPS, {}, [0.001, 0.002], None),  # of one instant
        (STAMPS, {}, [0.0, 7.0], None),  # no times of one scan
    ],
)
def test_points_of_a_cloud_as_swept_are_late(
    tmp_path: Path,
    names: list[str],
    images: dict[str, list[str]],
    times: list[float],
    late_s: list[float] | None,
) -> None:
    data = sweep(tmp_path, names, images, **dict.fromkeys(names, times))
    found = with_delays(rows(None), data).late_s
    if late_s is None:
        assert found is None
        return
    np.testing.assert_allclose(found, late_s, atol=1e-6)
    stands = rows(None).with_places(Places(stationary=((0, 1),)))
    np.testing.assert_array_equal(with_delays(stands, data).late_s, [0.0, 0.0])
    corrected = replace(
        data, frames=tuple(replace(f, find_motion=lambda: None) for f in data.frames)
    )
    assert with_delays(rows(None), corrected).late_s is None


def test_a_table_gets_the_motion_of_its_frames() -> None:
    rig = rig_of("kitti")
    cloud = np.ones((2, 10, 3))
    images = {n: np.zeros((2, c.height_px, c.width_px), np.uint8) for n, c in rig.cameras.items()}
    data = dataset_from_arrays(rig, cloud, images, twists_per_s=TWISTS)
    np.testing.assert_array_equal(with_motion(rows(None), data).twist_per_s, TWISTS)
    assert with_motion(rows(None), dataset_from_arrays(rig, cloud, images)).twist_per_s is None
    fast = replace(data.frames[0], twist=TWISTS[0] + [0, 0, 0, 300.0, 0, 0])
    with pytest.raises(MotionError, match="frame .* must be under 6 rad/s, .*the time between"):
        with_motion(rows(None), replace(data, frames=(fast, *data.frames[1:])))
    with pytest.raises(CalibrationError, match="twists_per_s"):
        dataset_from_arrays(rig, cloud, images, twists_per_s=TWISTS[:1])


def test_rig_files_and_kalibr_carry_the_times(tmp_path: Path) -> None:
    rig = rig_with(time_offset_s=0.021, time_offset_sigma_s=0.002, readout_s=0.03)
    rig.save(tmp_path / "rig.yaml")
    camera = load_rig(tmp_path / "rig.yaml").cameras["image_2"]
    assert (camera.time_offset_s, camera.time_offset_sigma_s) == (0.021, 0.002)
    assert (camera.readout_s, camera.readout_sigma_s) == (0.03, None)
    (chain,) = export_calibration(rig, tmp_path / "camchain.yaml", "kalibr")
    assert "timeshift_cam_lidar: 0.021" in Path(chain).read_text()
    assert import_rig([chain]).cameras["image_2"].time_offset_s == 0.021


def test_opencv_carries_the_times(tmp_path: Path) -> None:
    known, unknown = (
        rig_of("kitti").cameras["image_2"].model_copy(update=times)
        for times in ({"time_offset_s": 0.021, "readout_s": -0.03}, {})
    )
    rig = Rig(cameras={"known": known, "unknown": unknown})
    (opencv,) = export_calibration(rig, tmp_path / "rig.yml", "opencv")
    file = cv2.FileStorage(str(opencv), cv2.FILE_STORAGE_READ)
    first, second = (file.getNode(f"camera_{index}") for index in range(2))
    assert first.getNode("time_offset_s").real() == 0.021
    assert first.getNode("readout_s").real() == -0.03
    assert second.getNode("time_offset_s").empty() and second.getNode("readout_s").empty()


def test_evaluation_compares_times_that_both_rigs_state() -> None:
    found = evaluate(rig_with(time_offset_s=0.021, readout_s=0.03), rig_with(time_offset_s=0.02))
    assert found.time_offset_ms == pytest.approx(dict.fromkeys(found.cameras, 1.0))
    assert found.readout_ms == {}


WIDTH, HEIGHT = 1240, 376


def camera_of(model: str, distortion: tuple[float, ...] = (), focal: float = 600.0) -> Camera:
    camera = make_camera()
    k = Intrinsics(fx=focal, fy=focal, cx=(WIDTH - 1) / 2, cy=(HEIGHT - 1) / 2)
    changes = {"model": model, "distortion": distortion, "intrinsics_px": k}
    return camera.model_copy(update={**changes, "width_px": WIDTH, "height_px": HEIGHT})


def test_rigs_are_compared_by_their_lenses_in_the_corners() -> None:
    before, after = camera_of("pinhole"), camera_of("pinhole", (), 606.0)
    narrow = camera_of("pinhole", (-0.5, 0.0, 0.0, 0.0), 500.0)  # of the corners it has no ray
    apart = evaluate(
        Rig(cameras={"a": after, "same": before, "lost": before}),
        Rig(cameras={"a": before, "same": before, "lost": narrow}),
    ).lens_px
    assert apart.keys() == {"a", "lost"}
    assert apart["a"] == pytest.approx(0.01 * np.hypot(619.5, 187.5))
    assert apart["lost"] == np.inf


def test_a_calibrated_lens_is_known_to_a_500th_of_its_focal_length() -> None:
    rig = state_calibrated(make_pair())
    for camera in rig.cameras.values():
        sigma, fx = camera.intrinsics_sigma_px, camera.intrinsics_px.fx
        assert sigma.focal == pytest.approx(0.002 * fx, abs=0.006)  # written to 0.01 px
        assert sigma.centre == pytest.approx(0.002 * fx, abs=0.006)
        assert camera.distortion_sigma == 0.002
    doubted = {n: IN_DOUBT.state_in(c) for n, c in make_pair().cameras.items()}
    again = state_calibrated(Rig(cameras=doubted))
    for name, camera in again.cameras.items():
        assert camera.intrinsics_sigma_px == doubted[name].intrinsics_sigma_px


def test_a_lens_without_a_word_has_the_priors_of_a_stated_calibration() -> None:
    (camera, *_) = make_pair().cameras.values()
    (stated, *_) = state_calibrated(make_pair()).cameras.values()
    parts = ("focal", "centre", "distortion")
    without, with_sigmas = (
        LensVariable.of(each, parts, LensSigmas.calibrated(camera)).free.sigmas
        for each in (camera, stated)
    )
    assert with_sigmas == pytest.approx(without, rel=0.01)  # written to 0.01 px


def test_clouds_that_a_config_states_to_be_of_one_instant_are_not_late(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Solved(Exception):
        """With delays, the run is solved again."""

    def solve(rig: Rig, table: Correspondences, *_: object, **__: object) -> None:
        raise Solved(table.late_s)

    monkeypatch.setattr(rounds, "solve_joint", solve)
    data, rig = sweep(tmp_path, STAMPS, {}, **dict.fromkeys(STAMPS, [0.0, 0.1])), rig_of("kitti")
    for instant in (True, False):
        solution = SimpleNamespace(
            solved_rig=rig, rig=rig, config=Config(instant_clouds=instant), terms="full",
            camera_matches=None,
        )  # fmt: skip
        run: Any = SimpleNamespace(
            correspondences=rows(None), solution=solution, warnings=(), dataset=data, guess=rig
        )
        with nullcontext() if instant else pytest.raises(Solved):
            assert rounds.assign_places(run) is run
