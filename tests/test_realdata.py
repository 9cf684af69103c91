"""Real sensor data: the figures that the README gives. Minutes; skipped where the data are not."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import calibgraph
from calibgraph import Rig
from calibgraph.model.geometry import transform
from calibgraph.progress import no_progress
from calibgraph.rounds import match_in_rounds
from tests.conftest import require_near

pytestmark = pytest.mark.realdata


def sequences(realdata: Path, names: str) -> list[Path]:
    return [realdata / "kitti_odometry" / "sequences" / name for name in names.split("+")]


def start_and_reference(folders: list[Path], seed: int) -> tuple[Rig, Rig]:
    """A guess 2 deg and 0.2 m off, and the reference, which only judges."""
    reference = calibgraph.load_rig(folders[0])
    start = calibgraph.perturb(reference, rotation_deg=2, translation_m=0.2, seed=seed)
    return start, reference


@pytest.mark.parametrize("names", [pytest.param("00", marks=pytest.mark.ci), "06+07+08"])
def test_kitti_is_calibrated_from_2_deg_and_20_cm(realdata: Path, names: str) -> None:
    """One start each; benchmarks.accuracy.search has more, and from farther."""
    folders = sequences(realdata, names)
    start, reference = start_and_reference(folders, seed=0)
    matched = match_in_rounds(folders, start, progress=lambda *_: None)
    require_near(matched.solution.solved_rig, reference, deg=0.3, cm=8)


@pytest.mark.parametrize(("name", "frame"), [("05", 2), ("07", 0)])
def test_a_single_frame_is_found_from_10_deg_and_half_a_metre(
    realdata: Path, name: str, frame: int
) -> None:
    """Where the z-score of the search alone is below its limit."""
    (folder,) = sequences(realdata, name)
    data, reference = calibgraph.load_dataset(folder), calibgraph.load_rig(folder)
    start = calibgraph.perturb(reference, rotation_deg=10, translation_m=0.5, seed=frame)
    found = calibgraph.StructureMatcher().locate(
        data.select(str(frame)), start, out_of_time=lambda: False, progress=lambda *_: None
    )
    assert not found.findings.missed
    require_near(found.rig, reference, deg=1.0, cm=30)


@pytest.mark.parametrize("names", ["01", "08"])
def test_poor_scenes_are_not_passed(realdata: Path, names: str) -> None:
    """A motorway with 3 frames, and one place with 5: too little to be sure of, right or wrong."""
    start, _ = start_and_reference(sequences(realdata, names), seed=0)
    matcher = calibgraph.StructureMatcher(search_deg=None, search_m=None)  # quick
    result = calibgraph.calibrate(sequences(realdata, names), start, matcher)
    assert "PASS" not in [verdict.status for verdict in result.camera_verdicts.values()]


@pytest.mark.parametrize("name", ["surround6", "vlp16_distorted"])
def test_other_rigs_and_sensors_improve_in_rotation(realdata: Path, name: str) -> None:
    """Six cameras; 16 beams and a distorted lens. From the rig file's 2 deg and 0.2 m."""
    result = calibgraph.calibrate(realdata / name)
    reference = calibgraph.load_rig(realdata / name / "reference.yaml")
    for camera, error in calibgraph.evaluate(result.rig, reference).cameras.items():
        assert error.rotation_error_deg < 1.0, camera
    assert result.verdict.status != "PASS"  # 3 frames, or 8 of one spot with 16 beams


def test_a_camera_that_turns_half_a_degree_while_driving_is_found(
    realdata: Path, tmp_path: Path
) -> None:
    """19 frames of four sequences as one drive; the images of image_2 are turned from frame 10 on.

    A pure rotation about the camera's centre is a homography of the image, K R K^-1.
    """
    data = calibgraph.load_dataset(sequences(realdata, "05+06+07+08"))
    camera = data.rig.cameras["image_2"]
    turn = transform(Rotation.from_euler("y", 0.5, degrees=True))
    after = data.rig.moved_to({"image_2": turn @ camera.T_camera_lidar})
    warp = camera.matrix_px @ turn[:3, :3] @ np.linalg.inv(camera.matrix_px)
    (tmp_path / "drive" / "lidar").mkdir(parents=True)
    for number, frame in enumerate(data.frames):
        cloud = tmp_path / "drive" / "lidar" / f"{number:06d}{frame.cloud_path.suffix}"
        cloud.symlink_to(frame.cloud_path)
        for name, path in frame.image_paths.items():
            image = cv2.imread(str(path))
            if name == "image_2" and number >= 10:
                image = cv2.warpPerspective(image, warp, image.shape[1::-1], flags=cv2.INTER_CUBIC)
            folder = tmp_path / "drive" / "cameras" / name
            folder.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / f"{number:06d}.png"), image)
    drive = calibgraph.load_dataset(tmp_path / "drive", data.rig)
    guess = calibgraph.perturb(data.rig, rotation_deg=1, translation_m=0.1, seed=1)
    start = calibgraph.calibrate(drive.only(drive.frames[:5]), guess)
    matcher, tracker = calibgraph.StructureMatcher(), calibgraph.IncrementalCalibrator(start.rig)
    near, told = {"round_index": matcher.tracking_rounds[-1], "progress": no_progress}, []
    for frame in drive.frames:
        table = matcher.match(drive.only([frame]), tracker.rig, **near)
        told += [e for e in tracker.update(table).events if e.kind != "started"]
    assert [(e.kind, e.camera, e.frame) for e in told] == [("moved", "image_2", 10)]
    assert told[0].detected_frame <= 14
    found = tracker.calibration()
    require_near(found.rig, after, deg=0.3, cm=8)
