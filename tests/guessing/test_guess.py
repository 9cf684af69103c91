"""A rig from words or files."""

import json
from pathlib import Path

import numpy as np
import pytest

from calibgraph import RigError, export_calibration, guess_rig, load_rig
from calibgraph.guessing.guess import FILE_DEG
from calibgraph.guessing.mounting import (
    HEADINGS,
    SAID_DEG,
    WORD_SIGMAS,
    Mounting,
    check_forward,
    parse_mounting,
)
from calibgraph.model.geometry import camera_center, pose_difference
from tests.cli.conftest import error_line
from tests.conftest import SAMPLE, Call
from tests.io.formats.calibration_files import KALIBR, URDF, write

TRUTH = load_rig(SAMPLE / "reference.yaml")


@pytest.fixture
def lenses(tmp_path: Path) -> Path:
    """The lenses of the sample, with no extrinsics."""
    export_calibration(TRUTH, tmp_path / "lenses.yaml", "opencv")
    text = (tmp_path / "lenses.yaml").read_text().replace("T_camera_lidar:", "other:")
    (tmp_path / "lenses.yaml").write_text(text)
    return tmp_path / "lenses.yaml"


MOUNTED = {
    "front_left": "front, 30 cm left",
    "front_right": "front, 30 cm right, 0.4 m ahead, 0.3 m below",
    "left": "left, 0.3 m below",
}


def test_words_are_near_enough_for_the_search_that_is_proposed(lenses: Path) -> None:
    found = guess_rig([lenses], mountings=MOUNTED)
    for name, T in TRUTH.T_camera_lidar.items():
        degrees, centimetres = pose_difference(found.rig.T_camera_lidar[name], T)
        assert degrees < found.search_deg
        assert centimetres < 100 * found.search_m
    assert (found.search_deg, found.search_m) == (20.0, 1.8)
    assert found.cameras["left"].source == "words"


def test_frames_of_a_urdf_are_surer_than_words(tmp_path: Path) -> None:
    rig = guess_rig(write(tmp_path, camchain__yaml=KALIBR.replace("T_cam_lidar", "T_cam_imu"),
                          car__urdf=URDF.replace("front", "cam0")))  # fmt: skip
    assert {name: guess.source for name, guess in rig.cameras.items()} == {
        "cam0": "file", "cam1": "file",
    }  # fmt: skip
    assert rig.search_deg == 2 * FILE_DEG
    assert rig.search_m == 0.1


def test_words_stand_in_for_a_file(tmp_path: Path) -> None:
    files = write(tmp_path, camchain__yaml=KALIBR)
    found = guess_rig(files, mountings={"cam0": "rear, 1 m above"})
    np.testing.assert_allclose(
        found.rig.T_camera_lidar["cam0"], Mounting(180.0, place_m=(0, 0, 1)).T_camera_lidar(),
        atol=1e-12,
    )  # fmt: skip
    assert found.cameras["cam1"].source == "file"


def test_a_camera_is_placed_by_its_pose_to_one_with_words(tmp_path: Path) -> None:
    """cam1 is 0.11 m to the right of cam0, which looks ahead from the LiDAR."""
    files = write(tmp_path, camchain__yaml=KALIBR.replace("T_cam_lidar", "T_cam_imu"))
    found = guess_rig(files, mountings={"cam0": "front, 10 cm above"})
    centre = camera_center(found.rig.T_camera_lidar["cam1"])
    np.testing.assert_allclose(centre, (0.0, -0.11, 0.1), atol=1e-12)
    one, two = found.cameras.values()
    assert (one.source, two.source, two.text) == ("words", "pair", "by its pose to cam0")
    assert two.rotation_sigma_deg == one.rotation_sigma_deg
    shift_m = 0.11 * np.radians(one.rotation_sigma_deg)
    assert two.translation_sigma_m == pytest.approx(np.hypot(one.translation_sigma_m, shift_m))
    both = guess_rig(files, mountings={"cam0": "front", "cam1": "rear"})
    assert both.cameras["cam1"].source == "words"


def test_the_command_writes_a_rig_that_states_how_good_it_is(
    call: Call, lenses: Path, tmp_path: Path
) -> None:
    out = tmp_path / "rig.yaml"
    mounts = [part for name, text in MOUNTED.items() for part in ("--mount", f"{name}={text}")]
    code, stdout, err = call("rig", lenses, *mounts, "--out", out, "--json")
    assert code == 0
    assert json.loads(stdout)["cameras"]["left"]["source"] == "words"
    assert json.loads(stdout)["search_deg"] == 20.0
    text = out.read_text()
    assert text.startswith("# front_left looks along LiDAR +x")
    line = (
        "left looks along LiDAR +y, sits 0.30 m below the LiDAR; by words; 1 sigma: 10 deg, 0.8 m"
    )
    assert f"# {line}" in text and err == ""
    assert "# calibrate with --search-deg 20 --search-m 1.8" in text
    assert load_rig(out).cameras.keys() == TRUTH.cameras.keys()
    said = error_line(*call("rig", lenses, "--mount", "left=lft"))
    assert "camera 'left': 'lft' has 'lft', which is not understood" in said
    error_line(*call("rig", lenses, *mounts, "--forward", "up"))


def axis(mounting: Mounting, forward: str = "+x") -> np.ndarray:
    """(3,) where the camera looks, in the LiDAR frame."""
    return mounting.T_camera_lidar(check_forward(forward))[2, :3]


@pytest.mark.parametrize(
    ("words", "looks"),
    [
        ("front", (1, 0, 0)),
        ("left", (0, 1, 0)),
        ("rear", (-1, 0, 0)),
        ("back", (-1, 0, 0)),
        ("right", (0, -1, 0)),
        ("front-right", (np.sqrt(0.5), -np.sqrt(0.5), 0)),
        ("rear-left 45 deg right", (0, 1, 0)),
        ("front, 90 deg left", (0, 1, 0)),
        ("front, 90 deg down", (0, 0, -1)),
        ("front 30° up", (np.sqrt(0.75), 0, 0.5)),
        ("rear, 30 deg down", (-np.sqrt(0.75), 0, -0.5)),
    ],
)
def test_a_camera_looks_where_the_words_say(words: str, looks: tuple[float, ...]) -> None:
    np.testing.assert_allclose(axis(parse_mounting(words, "a")), looks, atol=1e-12)


@pytest.mark.parametrize(
    ("forward", "ahead", "left"),
    [("+x", "x", "y"), ("+y", "y", "-x"), ("-x", "-x", "-y"), ("-y", "-y", "x")],
)
def test_ahead_is_where_the_lidar_has_it(forward: str, ahead: str, left: str) -> None:
    unit = {"x": [1, 0, 0], "y": [0, 1, 0], "-x": [-1, 0, 0], "-y": [0, -1, 0]}
    np.testing.assert_allclose(axis(parse_mounting("front", "a"), forward), unit[ahead], atol=1e-12)
    T = parse_mounting("front, 2 m left", "a").T_camera_lidar(check_forward(forward))
    np.testing.assert_allclose(camera_center(T), 2 * np.array(unit[left]), atol=1e-12)


def test_a_camera_upside_down_sees_the_sky_below() -> None:
    T = parse_mounting("front, upside down", "a").T_camera_lidar()
    np.testing.assert_allclose(T[1, :3], (0, 0, 1), atol=1e-12)  # image down is up
    turned = parse_mounting("front, 90 deg clockwise", "a").T_camera_lidar()
    # Seen from behind, the top of the camera points right: image up is the vehicle's right.
    np.testing.assert_allclose(turned[1, :3], (0, 1, 0), atol=1e-12)
    np.testing.assert_allclose(
        axis(parse_mounting("front, upside down", "a")), (1, 0, 0), atol=1e-12
    )


def test_what_is_said_is_surer_than_what_is_left_open() -> None:
    open_ = parse_mounting("front", "a")
    assert dict(open_.sigmas) == WORD_SIGMAS
    said = parse_mounting("front 10 deg right, 2 m ahead, 0 m left, 1 m above", "a")
    assert said.sigmas["heading"] == SAID_DEG < WORD_SIGMAS["heading"]
    assert said.sigmas["tilt"] == WORD_SIGMAS["tilt"]
    assert said.sigmas["ahead"] == pytest.approx(np.hypot(0.05, 0.2))
    assert said.translation_sigma_m == said.sigmas["ahead"]
    assert said.rotation_sigma_deg == SAID_DEG


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("", "has no direction"),
        ("20 deg left", "has no direction"),
        ("sideways", "'sideways', which is not understood"),
        ("front rear", "gives the direction twice"),
        ("front, 10 deg left, 5 deg right", "gives the heading twice"),
        ("front, upside", "'upside'"),
        ("front, -20 deg down", "'-'"),
        ("front, 20 down", "'20 down'"),
        ("front, 20 deg", "'20 deg'"),
        ("front, 20 deg ahead", "'20 deg ahead'"),
        ("front, 3 ft ahead", "'3 ft ahead'"),
        ("front, 1 m ahead of the car", "'of'"),
        ("front, about 1 m ahead", "'about'"),
        ("front, 1e3 m ahead", "'1 e 3'"),
    ],
)
def test_what_is_not_understood_is_refused_with_what_is(words: str, said: str) -> None:
    with pytest.raises(RigError) as caught:
        parse_mounting(words, "cam")
    text = str(caught.value)
    assert said in text
    assert text.startswith("camera 'cam': ") and "\n" not in text
    assert all(heading in text for heading in HEADINGS)
