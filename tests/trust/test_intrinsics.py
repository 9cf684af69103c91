from __future__ import annotations

import re

import pytest

from calibgraph import Config, Correspondences, Rig, solve
from calibgraph.model.lens import IN_DOUBT, LensSigmas
from tests.draws.lenses import put_lens_error
from tests.trust.conftest import named, simulated


def test_right_intrinsics_pass(mixed_rig: Rig) -> None:
    result = solve(mixed_rig, simulated(mixed_rig))
    for name in mixed_rig.cameras:
        checks = named(result, name, "residuals over the image")
        assert [check.status for check in checks] == ["PASS"] * 4


@pytest.mark.parametrize("factor", [0.95, 1.03])
def test_a_wrong_focal_length_fails_and_is_measured(pair: Rig, factor: float) -> None:
    result = solve(put_lens_error(pair, "focal", factor - 1), simulated(pair))
    (check,) = named(result, "left", "a focal length")[:1]
    assert check.status == "FAIL"
    words = "shorter" if factor > 1 else "longer"
    assert f"% {words}" in check.text
    percent = float(check.text.split("a focal length ")[1].split()[0])
    # A tenth of it goes into the pose where the gate cuts: the loss is robust.
    assert percent == pytest.approx(100 * abs(1 / factor - 1), rel=0.1)


@pytest.mark.parametrize("error", [-0.04, 0.04])
def test_a_wrong_ratio_alone_is_no_pass_and_is_named(pair: Rig, error: float) -> None:
    result = solve(put_lens_error(pair, "aspect", error), simulated(pair))
    (check,) = named(result, "left", "a ratio fx / fy")
    assert check.status != "PASS"
    assert ("larger" if error < 0 else "smaller") in check.text


def test_images_undistorted_twice_fail(pair: Rig) -> None:
    result = solve(put_lens_error(pair, "distortion", -0.2), simulated(pair))
    assert named(result, "left", "a k1 ")[0].status == "FAIL"


def test_a_shifted_principal_point_fails_and_is_measured(pair: Rig) -> None:
    result = solve(put_lens_error(pair, "centre", 20.0), simulated(pair))
    (check,) = named(result, "left", "principal point")
    assert check.status == "FAIL"  # it turns the camera by a degree
    (found,) = re.findall(r"off by \((-[0-9.]+) ", check.text)
    assert abs(float(found) + 20) < 1


def test_a_wall_hides_a_wrong_focal_length_which_is_in_the_error_bar(pair: Rig) -> None:
    """On a wall straight ahead, one percent of focal length is one percent of its distance."""
    T = pair.T_camera_lidar["left"]
    table = simulated(pair).of_camera("left")
    ahead = table.points_lidar_m @ T[:3, :3].T + T[:3, 3]
    ahead *= 20.0 / ahead[:, 2:]
    wall = (ahead - T[:3, 3]) @ T[:3, :3]
    rigs = [
        Rig(cameras={"left": each.state_in(pair.cameras["left"])})
        for each in (LensSigmas.calibrated(pair.cameras["left"]), IN_DOUBT)
    ]
    flat = Correspondences.from_arrays(
        camera="left", frame=table.frame, pixels_px=table.pixels_px, points_lidar_m=wall
    )
    known, doubted = (solve(rig, flat, Config(common_deg=0.0)) for rig in rigs)
    assert doubted.sigmas("left")[1][2] > 8 * known.sigmas("left")[1][2] > 8.0  # cm
    assert doubted.verdict.status != "PASS"
