"""The comparison of results, on errors drawn from their covariances."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import calibgraph
from calibgraph import Calibration, CalibrationError, Check, Verdict
from calibgraph.model.geometry import transform
from tests.audit.drifting import draw, template, twist

FINE = {"tolerance_deg": 0.01, "tolerance_cm": 0.5}
WIDE = 6.0  # times the template's sigmas


def results(seed: int, count: int = 5, **changed: dict[str, np.ndarray]) -> dict[str, Calibration]:
    """Results "0", "1", ..., of which those named ``r0``, ``r1`` ... have moved cameras."""
    rng = np.random.default_rng(seed)
    return {str(k): draw(rng, changed.get(f"r{k}")) for k in range(count)}


def lidar_turned(degrees: float) -> Calibration:
    """A result after the LiDAR turned about its upward axis."""
    T = transform(Rotation.from_euler("z", degrees, degrees=True))
    of = draw(np.random.default_rng(9))
    return replace(of, rig=of.rig.moved_to({n: old @ T for n, old in of.T_camera_lidar.items()}))


def test_results_that_agree_are_ok() -> None:
    found = calibgraph.drift(results(0))
    assert found.status == "OK"
    assert found.changed == ()
    for entries in found.cameras.values():
        for each in entries:
            assert each.detectable is not None
            assert (each.detectable > 4 * each.sigma).all()


def test_the_result_that_deviates_is_named_with_its_camera_axis_and_size() -> None:
    found = calibgraph.drift(results(1, r2={"left": twist("yaw", 1.0)}))
    assert found.changed == (("2", "left"),)
    each = found.cameras["left"][2]
    assert each.axes == (1,)
    assert each.reason.startswith("turned about y (yaw) by +")
    assert abs(np.degrees(each.deviation[1]) - 1.0) < 4 * np.degrees(each.sigma[1])
    others = [e for name, all_ in found.cameras.items() for k, e in enumerate(all_) if k != 2]
    assert {e.status for e in others} == {"OK"}


def test_the_lidar_is_told_from_all_cameras() -> None:
    given = {**results(2, 4), "last": lidar_turned(1.0)}
    found = calibgraph.drift(given)
    assert found.changed == (("last", "LiDAR"),)
    lidar = found.lidar[-1]
    assert lidar is not None
    np.testing.assert_allclose(
        np.degrees(lidar.deviation[:3]), [0, 0, 1], atol=4 * np.degrees(lidar.sigma[:3].max())
    )


def test_cameras_that_moved_otherwise_are_not_taken_for_the_lidar() -> None:
    moves = {"left": twist("yaw", 1.0), "right": twist("yaw", -1.0)}
    found = calibgraph.drift(results(3, r1=moves))
    assert found.changed == (("1", "left"), ("1", "right"))


def test_of_two_results_it_is_not_known_which_changed() -> None:
    found = calibgraph.drift(results(4, 2, r1={"right": twist("ahead", 30)}))
    assert found.changed == (("0", "right"), ("1", "right"))
    for each in found.cameras["right"]:
        assert "of two results it is not known which changed" in each.reason


def test_a_camera_that_looks_back_is_named_though_its_twist_has_two_signs() -> None:
    for place in range(3):
        found = calibgraph.drift(results(4, 3, **{f"r{place}": {"left": twist("pitch", 180.0)}}))
        assert found.changed == ((str(place), "left"),)


def test_two_against_two_is_no_majority() -> None:
    move = {"left": twist("roll", 2.0)}
    found = calibgraph.drift(results(5, 4, r1=move, r3=move))
    reasons = [each.reason for each in found.cameras["left"] if each.status == "CHANGED"]
    assert reasons
    assert all("no more than half of the results agree" in reason for reason in reasons)


def test_a_wide_result_does_not_decide_between_two_sharp_ones() -> None:
    """The wide one agrees with either: 3 of its sigmas are more than they are apart."""
    rng = np.random.default_rng(6)
    size = 12 * np.degrees(np.sqrt(template().covariance["left"][1, 1]))
    given = {"a": draw(rng, {"left": twist("yaw", size)}), "b": draw(rng),
             "wide": draw(rng, {"left": twist("yaw", size / 2)}, wider=WIDE)}  # fmt: skip
    found = calibgraph.drift(given, **FINE)
    changed = {result for result, camera in found.changed if camera == "left"}
    assert "a" in changed
    assert "it may be b that changed" in found.cameras["left"][0].reason


def test_a_camera_that_failed_or_has_no_error_bar_takes_no_part() -> None:
    failed = Verdict((Check("convergence", "FAIL", "it did not converge"),))
    given = results(8, 5, r0={"left": twist("yaw", 5.0)}, r1={"right": twist("yaw", 5.0)})
    verdicts = given["0"].camera_verdicts
    given["0"] = replace(given["0"], camera_verdicts={**verdicts, "left": failed})
    given["1"] = replace(given["1"], covariance={**given["1"].covariance, "right": None})
    found = calibgraph.drift(given)
    assert found.status == "CANNOT TELL"
    assert "its verdict is FAIL" in found.cameras["left"][0].reason
    assert "no error bar" in found.cameras["right"][1].reason
    assert found.cameras["left"][0].deviation is None
    assert {each.status for each in found.cameras["left"][1:]} == {"OK"}
    found = calibgraph.drift({key: given[key] for key in ("0", "1")})
    assert "no other result has an error bar" in found.cameras["right"][0].reason


def test_an_error_bar_beyond_the_tolerance_cannot_tell() -> None:
    rng = np.random.default_rng(10)
    found = calibgraph.drift([draw(rng, wider=4 * WIDE) for _ in range(3)])
    assert found.status == "CANNOT TELL"
    assert "may be beyond the tolerance" in found.cameras["left"][0].reason


def test_results_of_other_rigs_are_refused_in_one_line() -> None:
    given = results(11, 2)
    alone = {"left": given["0"].rig.cameras["left"]}
    other = replace(given["0"], rig=given["0"].rig.model_copy(update={"cameras": alone}))
    with pytest.raises(CalibrationError, match="has the cameras left, 1 has left, right"):
        calibgraph.drift({"1": given["1"], "0": other})
    left = given["0"].rig.cameras["left"]
    lens = left.intrinsics_px.model_copy(update={"fx": 720.0})
    cameras = {**given["0"].rig.cameras, "left": left.model_copy(update={"intrinsics_px": lens})}
    given["0"] = replace(given["0"], rig=given["0"].rig.model_copy(update={"cameras": cameras}))
    with pytest.raises(CalibrationError, match="camera left has another image size or lens"):
        calibgraph.drift(given)
    assert calibgraph.drift(given, own_lenses=True).status == "OK"


def test_a_mount_is_not_compared_with_alignments() -> None:
    given = results(0, count=3)
    given["1"] = replace(given["1"], config=given["1"].config.model_copy(update={"of": "mount"}))
    with pytest.raises(CalibrationError, match="1: has poses of the mount, 0 of the alignment"):
        calibgraph.drift(given)


def test_a_copy_and_a_single_result_are_refused() -> None:
    one = draw(np.random.default_rng(12))
    with pytest.raises(CalibrationError, match="result 2: is the same result as result 1"):
        calibgraph.drift([one, one])
    with pytest.raises(CalibrationError, match="needs two or more"):
        calibgraph.drift([one])


def test_results_of_one_recording_are_named() -> None:
    rng = np.random.default_rng(12)
    files = [{"a": "1", "b": "2"}, {"a": "3"}, {"elsewhere/b": "2"}, {}, {}]
    given = [replace(draw(rng), inputs=each) for each in files]
    found = calibgraph.drift(given)
    assert found.same_recording == (("result 1", "result 3"),)
    assert found.same_recording_note.startswith("Made from one recording: result 1 and result 3.")
    assert calibgraph.drift(given[1:3]).same_recording_note == ""


def test_unchanged_rigs_raise_at_most_one_false_alarm_in_a_hundred() -> None:
    """With a tolerance of next to nothing, so that whatever is significant is CHANGED."""
    rng, draws = np.random.default_rng(14), 100
    alarms = sum(
        calibgraph.drift(
            [draw(rng) for _ in range(3)], tolerance_deg=1e-6, tolerance_cm=1e-6
        ).status
        == "CHANGED"
        for _ in range(draws)
    )
    assert alarms <= 1 + 4  # a Poisson count of at most 1 %


@pytest.mark.ci
@pytest.mark.statistics
def test_the_smallest_detectable_change_is_found_as_often_as_stated() -> None:
    rng, draws = np.random.default_rng(15), 90
    others = [draw(rng) for _ in range(3)]
    size = calibgraph.drift(others, **FINE).cameras["left"][0].detectable
    found = 0
    for k in range(draws):
        xi = np.eye(6)[k % 6] * size
        given = [draw(rng), draw(rng), draw(rng, {"left": xi})]
        each = calibgraph.drift(given, tolerance_deg=1e-6, tolerance_cm=1e-6).cameras["left"][2]
        found += k % 6 in each.axes
    assert abs(found - 0.9 * draws) < 4 * np.sqrt(draws * 0.9 * 0.1)
