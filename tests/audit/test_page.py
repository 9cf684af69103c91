"""The page of an audit: everything of it, nothing fetched, whatever is missing."""

from dataclasses import replace
from pathlib import Path

import numpy as np

import calibgraph
from calibgraph import Audit, CameraAudit
from calibgraph.audit.page import measured_camera
from calibgraph.model.geometry import twist_between
from tests.audit.deployed import TRUTH
from tests.conftest import SAMPLE
from tests.report.conftest import read_page

DEVIATION = np.array([0.001, 0.02, 0, 0.01, 0, -0.02])
SIGMA = np.repeat([0.001, 0.01], 3)
WRONG = CameraAudit("WRONG", "turned about y (yaw)", DEVIATION, SIGMA, 5 * SIGMA, 30.0)
RIGHT = CameraAudit("OK", "no significant deviation", 0.1 * DEVIATION, SIGMA, 5 * SIGMA, 30.0)
FEW = CameraAudit("CANNOT TELL", "too few frames: record at least 5", DEVIATION)
NOTHING = CameraAudit("CANNOT TELL", "0 usable correspondences")


def audit_with(*cameras: CameraAudit, lidar: CameraAudit | None = None) -> Audit:
    """Of the first cameras of the sample, with its images and clouds."""
    names = [*TRUTH.cameras][: len(cameras)]
    rig = TRUTH.model_copy(update={"cameras": {name: TRUTH.cameras[name] for name in names}})
    found = dict(zip(names, cameras, strict=True))
    frame = calibgraph.load_dataset(SAMPLE, rig).frames[0]
    numbers = 0.5, 10.0, 6, {"match": 1.5}
    return Audit(found, lidar, rig, frame, (str(SAMPLE),), *numbers)


def page_of(audit: Audit, folder: Path) -> str:
    """The text of its page, which refers to nothing outside of itself."""
    return read_page(calibgraph.write_audit_report(audit, folder / "check.html"))


def test_each_camera_has_its_answer_and_its_pictures(tmp_path: Path) -> None:
    lidar = CameraAudit(
        "WRONG", "turned about z by +1.00 deg", np.array([0, 0, 0.0175, 0, 0, 0]), SIGMA
    )
    for audit, pictures, parts in (
        (audit_with(WRONG, RIGHT), 4,
         ("No. front_left is not where the calibration has it.", "6 frames were matched")),
        (audit_with(FEW, FEW, NOTHING), 5,
         ("cannot tell for front_left, front_right, left.", "nothing was measured",
          "<b>front_left, front_right</b>: too few frames: record at least 5")),
        (audit_with(RIGHT), 2, ("Yes.", "No camera deviates by more than the tolerance")),
        (audit_with(WRONG, WRONG, lidar=lidar), 4,
         ("No. LiDAR is not", "<b>LiDAR</b>: turned about z by +1.00 deg; all cameras agree")),
    ):  # fmt: skip
        text = page_of(audit, tmp_path)
        assert text.count("data:image/jpeg") == pictures
        assert [part for part in parts if part not in text] == []


def test_where_the_deployed_calibration_is_from_stands_beside_the_answer(tmp_path: Path) -> None:
    """As in the terminal: an OK alone would hide a doubtful result, or a recording that made it."""
    right = audit_with(RIGHT)
    for audit, expected in (
        (right, (False, False)),
        (replace(right, deployed_verdict="PASS"), (False, False)),
        (replace(right, same_recording=True), (True, False)),
        (replace(right, same_recording=True, deployed_verdict="WARN"), (True, True)),
    ):
        text = page_of(audit, tmp_path)
        assert ("made from this recording" in text, "This result was WARN" in text) == expected
        assert ("Nothing: keep it in use." in text) != any(expected)


def test_images_that_are_gone_are_named(tmp_path: Path) -> None:
    audit = audit_with(WRONG)
    gone = replace(audit, shown=replace(audit.shown, cloud_path=tmp_path / "gone.npy"))
    assert "gone.npy: no such file; check the path." in page_of(gone, tmp_path)


def test_the_measured_camera_deviates_as_was_measured() -> None:
    deployed = TRUTH.cameras["left"]
    measured = measured_camera(deployed, WRONG)
    assert measured is not None
    found = twist_between(deployed.T_camera_lidar, measured.T_camera_lidar)
    np.testing.assert_allclose(found, DEVIATION, atol=1e-12)
    assert measured_camera(deployed, NOTHING) is None
