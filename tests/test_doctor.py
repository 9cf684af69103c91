"""What is wrong with a dataset is found before it is solved."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibgraph import Dataset, Diagnosis, Rig, diagnose, doctor, load_rig
from tests.conftest import SAMPLE, Call


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of two cameras of the sample, of one place."""

    def one_place(data: Dataset, *_: object) -> list[list[int]]:
        return [[frame.index for frame in data.frames]]

    monkeypatch.setattr(doctor, "find_places", one_place)
    folder = Path(shutil.copytree(SAMPLE, tmp_path / "sample"))
    shutil.rmtree(folder / "cameras" / "front_right")
    cameras = load_rig(SAMPLE).cameras
    Rig(cameras={n: cameras[n] for n in ("front_left", "left")}).save(folder / "rig.yaml")
    return folder


def texts(found: Diagnosis, level: str) -> list[str]:
    return [finding.text for finding in found.findings if finding.level == level]


@pytest.mark.usefixtures("no_image_checks")
def test_damaged_sources_are_listed_with_the_frames_that_do_not_pair(folder: Path) -> None:
    (folder / "cameras/left/000002.jpg").unlink()
    for name in ("000000", "000001"):
        path = folder / f"cameras/front_left/{name}.jpg"
        path.write_bytes(path.read_bytes()[:-50])
    (folder / "lidar/000003.npy").write_bytes(b"nothing")
    cv2.imwrite(str(folder / "cameras/left/000005.jpg"), np.zeros((360, 640, 3), np.uint8))
    found = diagnose(str(folder), pictures=folder / "pictures")
    errors = texts(found, "error")
    assert not found.healthy
    assert [finding.level for finding in found.findings[: len(errors)]] == ["error"] * len(errors)
    for expected in (
        "frame '000002' has a cloud but no image of camera 'left'",
        "front_left/000000.jpg: is damaged, or not an image of its kind (Premature end of JPEG "
        "file); record or copy it again; 1 more of its frames have errors",
        "000003.npy: cannot be read",
        "left/000005.jpg: all pixels are 0",
    ):
        assert sum(expected in error for error in errors) == 1, expected
    assert found.frames == 5
    assert not (folder / "pictures").exists()


@pytest.mark.usefixtures("no_image_checks")
def test_repeated_clouds_and_images_are_named(folder: Path) -> None:
    shutil.copy(folder / "lidar/000001.npy", folder / "lidar/000004.npy")
    for name in ("000003", "000005"):
        shutil.copy(folder / "cameras/left/000002.jpg", folder / f"cameras/left/{name}.jpg")
    found = diagnose([folder])
    assert found.healthy
    assert texts(found, "warning") == [
        "frames 000001 and 000004 have the same cloud; leave repeats out",
        "frames 000002 and 000003 have the same image of left, and 1 more repeat one; leave "
        "repeats out",
    ]
    assert (
        "4 frames: the error bar will be a wide default"
        in texts(diagnose([folder], frames="0:4"), "warning")[0]
    )


@pytest.mark.usefixtures("no_image_checks")
def test_a_vehicle_that_stands_is_named(folder: Path) -> None:
    for camera in (folder / "cameras").iterdir():
        for name in ("000003", "000004"):
            shutil.copy(camera / "000002.jpg", camera / f"{name}.jpg")
    warnings = texts(diagnose([folder]), "warning")
    assert warnings[-1].startswith(
        "6 frames count as 4: the vehicle stands, as in 3 frames from 000002 to 000004;"
    )


def test_a_guess_in_millimetres_is_named_by_what_the_images_show_first() -> None:
    rig = load_rig(SAMPLE)
    T = rig.T_camera_lidar["left"].copy()
    T[:3, 3] *= 1000.0
    found = diagnose([SAMPLE], rig.moved_to({"left": T}))
    assert found.points_in_image["left"] == 0
    assert texts(found, "error") == [
        "the images of left fit clearly better if the guess has a translation in millimetres; undo "
        "it with calibgraph rig RIG --correct left=millimetres --out FILE.yaml",
        "left: by the guess, no point of the cloud lies in the image",
    ]
    assert texts(found, "warning") == [
        "left: the camera is 351 m from the LiDAR: lengths in millimetres or centimetres?"
    ]


def change_clouds(folder: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    for path in (folder / "lidar").iterdir():
        np.save(path, change(np.load(path)))


@pytest.mark.usefixtures("no_image_checks")
@pytest.mark.parametrize(
    ("scale", "expected"),
    [
        (1000, "9332 m, above the limit 1000 m: are the clouds in millimetres?"),
        (100, "933 m, above the limit 200 m: are the clouds in centimetres?"),
    ],
)
def test_clouds_in_other_units_are_named_with_their_distance(
    folder: Path, scale: float, expected: str
) -> None:
    change_clouds(folder, lambda cloud: cloud * np.float32([scale] * 3 + [1])[: cloud.shape[1]])
    assert texts(diagnose([folder]), "warning") == [f"median distance of the points: {expected}"]


@pytest.mark.usefixtures("no_image_checks")
def test_the_command_prints_it_and_exits_with_one_if_anything_is_to_be_fixed(
    call: Call, folder: Path
) -> None:
    code, out, err = call("doctor", folder)
    assert (code, out) == (0, "")
    assert "note     6 frames, 2 cameras\n" in err and "note     1 place: frames 0-5\n" in err
    (folder / "lidar/000003.npy").unlink()
    code, out, _ = call("doctor", folder, "--json")
    assert code == 1
    assert json.loads(out)["healthy"] is False
    code, _, err = call("doctor", folder / "missing")
    assert code == 1
    assert "no such folder or ROS bag" in err


@pytest.mark.usefixtures("no_image_checks")
def test_the_brightness_of_images_that_show_too_little_is_named(folder: Path) -> None:
    for name, scale, lift in (("left", 0.12, 0), ("front_left", 0.2, 215)):
        for path in folder.glob(f"cameras/{name}/*"):
            image = cv2.imread(str(path))
            assert image is not None
            cv2.imwrite(str(path), np.clip(image * scale + lift, 0, 255).astype(np.uint8))
    found = sorted(texts(diagnose([folder]), "warning"))
    for text, (name, word) in zip(found, (("front_left", "bright"), ("left", "dark")), strict=True):
        said = f"the images of {name} are too {word} to show structure: their mean"
        assert text.startswith(said)
