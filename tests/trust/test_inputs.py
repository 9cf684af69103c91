"""Mistakes in the inputs stop a calibration before it searches, or are recorded in its result."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

import numpy as np
import pytest

import calibgraph
from calibgraph import Intrinsics, load_calibration, load_rig
from calibgraph.model.verdict import Check
from calibgraph.trust.assess import implausible_checks
from calibgraph.trust.inputs import check_inputs
from tests.conftest import SAMPLE, Call

RIG = load_rig(SAMPLE)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of the sample's first frames."""
    copy = Path(shutil.copytree(SAMPLE, tmp_path / "sample"))
    for path in (*copy.glob("lidar/*"), *copy.glob("cameras/*/*")):
        if path.stem > "000001":
            path.unlink()
    return copy


def with_principal_point(cx: float, cy: float) -> calibgraph.Rig:
    left = RIG.cameras["left"]
    lens = Intrinsics(**{**left.intrinsics_px.model_dump(), "cx": cx, "cy": cy})
    cameras = {**RIG.cameras, "left": left.model_copy(update={"intrinsics_px": lens})}
    return RIG.model_copy(update={"cameras": cameras})


def test_the_sample_has_no_warning() -> None:
    assert check_inputs(calibgraph.load_dataset(SAMPLE), RIG) == ()


def test_a_rig_whose_cameras_all_see_no_point_is_refused_before_the_search(
    folder: Path, call: Call
) -> None:
    for path in (folder / "lidar").iterdir():
        cloud = np.load(path)
        cloud[:, :2] *= -1
        np.save(path, cloud)
    code, _, err = call("calibrate", folder, "--out", folder / "out")
    assert code == 2
    assert err.count("turned by 180 deg about z (its x points behind, y right, z up)") == 1
    assert "left: by the guess, no point of the cloud lies in the image" in err
    assert not (folder / "out").exists()


def test_a_camera_of_several_that_sees_no_point_is_a_warning() -> None:
    T = RIG.T_camera_lidar["left"].copy()
    T[:3, :3] = np.diag([-1.0, 1.0, -1.0]) @ T[:3, :3]  # to the right, where the LiDAR is blind
    warnings = check_inputs(calibgraph.load_dataset(SAMPLE), RIG.moved_to({"left": T}))
    assert warnings == ("left: by the guess, no point of the cloud lies in the image",)


@pytest.mark.usefixtures("no_image_checks")
def test_warnings_are_logged_and_recorded_and_nothing_is_printed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    data = calibgraph.load_dataset(SAMPLE).select("0:2")
    table = calibgraph.simulate_correspondences(RIG, frames=2, matches=200, seed=1)
    with caplog.at_level(logging.WARNING, "calibgraph"):
        result = calibgraph.calibrate(data, with_principal_point(80, 45), table)
    assert result.warnings == tuple(caplog.messages)
    assert "principal point (80, 45)" in result.warnings[0]
    assert load_calibration(result.save(tmp_path)).warnings == result.warnings
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(("limits", "expected"), [((None, None), "FAIL"), ((1.0, 2.0), "WARN")])
def test_a_failure_is_explained_but_not_decided_by_values_of_the_rig(
    limits: tuple[float | None, float | None], expected: str
) -> None:
    failed = Check("z-score", "FAIL", "", 3.0, *limits)
    rig = with_principal_point(80, 45)
    ((name, (check,)),) = implausible_checks(rig, {"left": [failed]}).items()
    assert (name, check.status) == ("left", expected)
    assert check.text.startswith("principal point (80, 45)")
    passed = Check("z-score", "PASS", "", 30.0)
    assert implausible_checks(rig, {"left": [passed]}) == {}
