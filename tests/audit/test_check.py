"""The audit of a deployed calibration, on the sample: its answer, its rounds, its origin."""

import shutil
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

import calibgraph
from calibgraph import Audit, Correspondences, Dataset, Rig, simulate_correspondences
from calibgraph.audit.check import match_from_deployed, provenance
from calibgraph.io.dataset import keep_frames
from calibgraph.matching.protocol import FullMatcher
from calibgraph.matching.structure.matcher import StructureMatcher
from calibgraph.model.config import Config
from calibgraph.model.findings import MatcherFindings
from calibgraph.progress import Progress, Stopwatch, no_progress
from tests.audit.deployed import TRUTH, motion, with_camera_moved
from tests.conftest import SAMPLE, CommandRun, stereo_relative_pose
from tests.matching.structure.data import with_noise_images

TABLE = simulate_correspondences(TRUTH, frames=6)


@cache
def sample() -> Dataset:
    """The sample, whose features are found once."""
    return keep_frames(calibgraph.load_dataset(SAMPLE, TRUTH))


def with_lidar_moved(rig: Rig, T: np.ndarray) -> Rig:
    """The rig as deployed before the LiDAR moved by T, in its own axes."""
    return rig.moved_to({name: old @ np.linalg.inv(T) for name, old in rig.T_camera_lidar.items()})


def check_by_table(deployed: Rig) -> Audit:
    """The audit by simulated correspondences of the truth, and the sample's images."""
    return calibgraph.check(deployed, sample(), matcher=TABLE)


def test_a_right_rig_is_ok() -> None:
    audit = check_by_table(TRUTH)
    assert audit.status == "OK"
    assert audit.wrong == ()
    assert audit.lidar is None
    assert audit.frames == 6
    for camera in audit.cameras.values():
        assert camera.deviation is not None
        assert camera.sigma is not None
        assert camera.detectable is not None
        assert (camera.detectable > 2.9 * camera.sigma).all()
    assert audit.shown is not None and audit.shown.kept is None, "decoded frames"


def test_the_camera_that_was_moved_is_wrong_and_the_others_are_ok() -> None:
    """Relative poses hold what was deployed, which is what is in question: they take no part."""
    moved = with_camera_moved(TRUTH, "front_right", motion(0, metres=0.2))
    pose = stereo_relative_pose(moved, "front_left", "front_right")
    audit = check_by_table(moved.model_copy(update={"relative_poses": (pose,)}))
    assert audit.wrong == ("front_right",)
    assert audit.lidar is None
    assert audit.cameras["front_right"].reason.startswith("moved along x (right) by +")
    np.testing.assert_allclose(audit.cameras["front_right"].deviation[3:], [0.2, 0, 0], atol=0.02)
    assert {n for n, c in audit.cameras.items() if c.status == "OK"} == {"front_left", "left"}


def test_a_motion_of_the_lidar_is_told_from_that_of_all_cameras() -> None:
    audit = check_by_table(with_lidar_moved(TRUTH, motion(2, degrees=1)))
    assert audit.status == "WRONG"
    assert audit.wrong == ("LiDAR",)
    assert audit.lidar is not None
    assert "turned about z by +" in audit.lidar.reason
    np.testing.assert_allclose(np.degrees(audit.lidar.deviation[:3]), [0, 0, 1], atol=0.05)


def test_all_cameras_moved_otherwise_are_not_taken_for_the_lidar() -> None:
    deployed = TRUTH
    for axis, name in enumerate(TRUTH.cameras):
        deployed = with_camera_moved(deployed, name, motion(axis, degrees=1))
    audit = check_by_table(deployed)
    assert audit.lidar is None
    assert audit.wrong == tuple(TRUTH.cameras)


def test_a_single_camera_is_wrong_or_its_lidar_is() -> None:
    truth = TRUTH.model_copy(update={"cameras": {"left": TRUTH.cameras["left"]}})
    table = simulate_correspondences(truth, frames=6)
    deployed = with_camera_moved(truth, "left", motion(1, degrees=1))
    audit = calibgraph.check(deployed, SAMPLE, matcher=table)
    assert audit.wrong == ("left",)
    assert "a single camera cannot be told from the LiDAR" in audit.cameras["left"].reason


def test_a_table_of_another_rig_is_an_error() -> None:
    """Not CANNOT TELL: no recording would help."""
    alone = TRUTH.model_copy(update={"cameras": {"left": TRUTH.cameras["left"]}})
    with pytest.raises(calibgraph.CorrespondenceError, match="is not in the rig"):
        calibgraph.check(alone, SAMPLE, matcher=TABLE)


def test_correspondences_that_determine_no_camera_cannot_tell() -> None:
    audit = calibgraph.check(TRUTH, sample(), matcher=TABLE.select(slice(0, 5)))
    assert {camera.status for camera in audit.cameras.values()} == {"CANNOT TELL"}


@pytest.mark.slow
def test_images_without_structure_cannot_tell(tmp_path: Path) -> None:
    two = TRUTH.model_copy(
        update={"cameras": {n: TRUTH.cameras[n] for n in ("front_left", "left")}}
    )
    data = calibgraph.load_dataset(SAMPLE, two)
    audit = calibgraph.check(two, with_noise_images(data, "left", tmp_path))
    assert audit.cameras["left"].status == "CANNOT TELL"
    assert audit.cameras["front_left"].status == "OK"
    assert audit.status == "CANNOT TELL"


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [2.0, 4.0, 8.0, 15.0])
def test_a_rig_that_is_wrong_by_degrees_is_never_ok(degrees: float) -> None:
    data = calibgraph.load_dataset(SAMPLE, TRUTH)
    for seed in range(2):
        deployed = calibgraph.perturb(TRUTH, rotation_deg=degrees, translation_m=0.3, seed=seed)
        audit = calibgraph.check(deployed, data, matcher=StructureMatcher(seed=seed))
        assert "OK" not in {camera.status for camera in audit.cameras.values()}


@pytest.mark.slow
def test_a_camera_that_moved_during_the_recording_is_not_ok(tmp_path: Path) -> None:
    """The solve leaves the frames after it out, and what is left agrees."""
    data = Path(shutil.copytree(SAMPLE, tmp_path / "data"))
    camera = TRUTH.cameras["front_left"]
    assert not any(camera.distortion)  # a turn of the camera is a homography
    turned = camera.matrix_px @ motion(1, degrees=1.5)[:3, :3] @ np.linalg.inv(camera.matrix_px)
    for path in sorted((data / "cameras" / "front_left").iterdir())[3:]:
        image = cv2.imread(str(path))
        cv2.imwrite(str(path), cv2.warpPerspective(image, turned, image.shape[1::-1]))
    audit = calibgraph.check(TRUTH, data)
    moved = audit.cameras["front_left"]
    assert moved.status == "CANNOT TELL"
    assert "000003, 000004, 000005 fit another extrinsic better" in moved.reason
    assert {audit.cameras[name].status for name in ("front_right", "left")} == {"OK"}


def test_copies_of_a_frame_are_left_out_and_named(caplog: pytest.LogCaptureFixture) -> None:
    data = sample()
    copied = [replace(data.frames[0], index=100 + k, name=f"copy{k}") for k in range(2)]
    data = replace(data, frames=(*data.frames, *copied))
    assert calibgraph.check(TRUTH, data, matcher=TABLE).frames == 6
    assert "frames 000000 and copy0 have the same cloud and images, and 1 more" in caplog.text


@dataclass
class MatcherOfTruth:
    """Finds the correspondences of the truth in every round; notes which rounds were asked for."""

    z_score: float = 40.0
    camera_without: str = ""
    rounds: int = 5
    stage1: str = "rig"
    tracking_rounds: tuple[int, ...] = (2, 4)
    asked: list[int] = field(default_factory=list)

    def match(
        self, dataset: Dataset, rig: Rig, *, round_index: int, progress: Progress
    ) -> Correspondences:
        self.asked.append(round_index)
        findings = MatcherFindings(z_score=dict.fromkeys(rig.cameras, self.z_score))
        table = replace(TABLE, metadata={**TABLE.metadata, **findings.to_metadata()})
        missing = self.camera_without and self.asked == [4]
        if not missing:
            return table
        return table.select(table.camera_index != table.cameras.index(self.camera_without))


def rounds_from(deployed: Rig, matcher: MatcherOfTruth) -> list[int]:
    """The rounds that are run from a deployed rig."""
    match_from_deployed(
        sample(), deployed, FullMatcher(matcher), Config().changed(stage1="rig"),
        watch=Stopwatch(), progress=no_progress,
    )  # fmt: skip
    return matcher.asked


@pytest.mark.parametrize(
    ("metres", "matcher", "rounds"),
    [
        (0.0, MatcherOfTruth(), [4]),
        (0.03, MatcherOfTruth(), [4]),
        (0.06, MatcherOfTruth(), [4, 2, 4]),  # beyond the motion of a last round
        (0.30, MatcherOfTruth(), [4, 2, 4, 0, 2, 4]),  # and of the reach of the tracking rounds
        (0.0, MatcherOfTruth(z_score=12.0), [4, 2, 4, 0, 2, 4]),
        # it is held where it is deployed, which is no measurement
        (0.0, MatcherOfTruth(camera_without="left"), [4, 2, 4]),
    ],
)
def test_more_rounds_are_run_the_farther_off_or_the_less_confirmed_the_deployed_rig_is(
    metres: float, matcher: MatcherOfTruth, rounds: list[int]
) -> None:
    deployed = with_camera_moved(TRUTH, "left", motion(0, metres=metres))
    assert rounds_from(deployed, matcher) == rounds


def test_the_recording_of_a_result_is_known_by_its_content_wherever_it_lies(
    calibrated_sample: CommandRun, tmp_path: Path
) -> None:
    result, rig = calibrated_sample.folder, calibgraph.load_rig(SAMPLE / "rig.yaml")
    assert provenance(result, calibgraph.load_dataset(SAMPLE, rig))[0]
    other = Path(shutil.copytree(SAMPLE, tmp_path / "other"))
    assert provenance(result / "calibration.yaml", calibgraph.load_dataset(other, rig))[0]
    for cloud in calibgraph.load_dataset(other, rig).frames:  # the same names, other clouds
        cloud.cloud_path.write_bytes(cloud.cloud_path.read_bytes()[:-32])
    assert not provenance(result, calibgraph.load_dataset(other, rig))[0]
    assert not provenance(SAMPLE / "rig.yaml", calibgraph.load_dataset(SAMPLE, rig))[0]


def test_a_result_of_mounts_is_refused(calibrated_sample: CommandRun, tmp_path: Path) -> None:
    text = (calibrated_sample.folder / "calibration.yaml").read_text("utf-8")
    assert "of: alignment" in text
    deployed = tmp_path / "calibration.yaml"
    deployed.write_text(text.replace("of: alignment", "of: mount"), "utf-8")
    data = calibgraph.load_dataset(SAMPLE, calibgraph.load_rig(SAMPLE / "rig.yaml"))
    with pytest.raises(calibgraph.CalibrationError, match=r"poses of the mount.*--of alignment"):
        provenance(deployed, data)
