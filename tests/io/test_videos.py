"""Videos as the images of a camera: the picture of a cloud is the one of its time."""

from __future__ import annotations

import re
import shutil
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from calibgraph import CalibrationError, calibrate, evaluate, load_dataset, load_rig
from calibgraph.client.inputs import files_of
from tests.conftest import SAMPLE

LEFT = "left"
BETWEEN = 7  # pictures from a cloud to the next


def write_video(path: Path, pictures: list[np.ndarray], codec: str = "libx264") -> None:
    """With pictures that refer to earlier and later ones, as cameras write them."""
    with av.open(str(path), "w") as file:
        stream = file.add_stream(codec, rate=Fraction(30))
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt, stream.options = "yuv444p", {"crf": "1", "bf": "2", "g": "12"}
        for pixels in pictures:
            for packet in stream.encode(av.VideoFrame.from_ndarray(pixels, format="bgr24")):
                file.mux(packet)
        for packet in stream.encode():
            file.mux(packet)


def marked(number: int) -> np.ndarray:
    return np.full((64, 96, 3), 3 * number, np.uint8)


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The images of the sample's left camera."""
    data, path = load_dataset(SAMPLE), tmp_path_factory.mktemp("video") / f"{LEFT}.mp4"
    write_video(path, [f.load_image(LEFT, data.rig.cameras[LEFT]) for f in data.frames])
    return path


@pytest.fixture
def dataset(video: Path, tmp_path: Path) -> Path:
    """The sample, whose left camera has a video; its clouds are named by stamps."""
    folder = Path(shutil.copytree(SAMPLE, tmp_path / "recording"))
    shutil.rmtree(folder / "cameras" / LEFT)
    shutil.copy(video, folder / "cameras")
    return folder


def test_a_video_of_as_many_pictures_as_clouds_pairs_in_order(dataset: Path) -> None:
    data, given = load_dataset(dataset), load_dataset(SAMPLE)
    assert [frame.name for frame in data.frames] == [frame.name for frame in given.frames]
    for one, two in zip(data.frames, given.frames, strict=True):
        pixels = [each.load_image(LEFT, given.rig.cameras[LEFT]).astype(int) for each in (one, two)]
        assert np.abs(pixels[0] - pixels[1]).mean() < 2.0
    hashes = {frame.hashes()[str(frame.image_paths[LEFT])] for frame in data.frames}
    assert len(hashes) == len(data.frames)
    names = {path.name for path in files_of(dataset)}
    assert f"{LEFT}.mp4" in names


def test_a_cloud_belongs_to_the_picture_that_is_nearest_in_time(tmp_path: Path) -> None:
    folder = Path(shutil.copytree(SAMPLE, tmp_path / "recording"))
    shutil.rmtree(folder / "cameras")
    (folder / "cameras").mkdir()
    start, step = 1_700_000_000_000_000_000, 33_333_333
    write_video(folder / "cameras" / "left.mp4", [marked(k) for k in range(60)])
    (folder / "cameras" / "left.txt").write_text(
        "\n".join(str(start + k * step) for k in range(60))
    )
    wanted = {}
    for index, path in enumerate(sorted((folder / "lidar").iterdir())):
        number = 3 + BETWEEN * index
        late = 15_000_000 if index % 2 else -15_000_000
        wanted[str(start + number * step + late)] = number
        path.rename(path.with_stem(str(start + number * step + late)))
    (folder / "lidar" / "1.npy").write_bytes(next((folder / "lidar").iterdir()).read_bytes())
    rig = load_dataset(SAMPLE).rig
    camera = rig.cameras[LEFT].model_copy(update={"width_px": 96, "height_px": 64})
    one = rig.model_copy(update={"cameras": {LEFT: camera}})
    with pytest.raises(CalibrationError, match="'1' has a cloud but no image of camera 'left'"):
        load_dataset(folder, one)
    (folder / "lidar" / "1.npy").unlink()
    for frame in reversed(load_dataset(folder, one).frames):  # backwards: every one is sought
        pixels = frame.load_image(LEFT, camera)
        assert abs(float(pixels.mean()) - 3 * wanted[frame.name]) < 1.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: p.write_bytes(p.read_bytes()[:2000]), "cannot be read as a video"),
        (lambda p: p.write_bytes(b"text"), "cannot be read as a video"),
        (lambda p: write_video(p, [marked(k) for k in range(4)]), "has 4 pictures beside 6 clouds"),
        (lambda p: write_video(p, [marked(k) for k in range(6)]), "is 96x64 px, the rig says"),
        (
            lambda p: p.with_suffix(".txt").write_text("1\n2\n"),
            "has 2 stamps, the video 6 pictures",
        ),
        (lambda p: p.with_suffix(".txt").write_text("1 2 3 4 5 x"), "expected stamps that are num"),
        (lambda p: p.with_suffix(".txt").write_text("1 2 3 4 4 5"), "stamps do not increase"),
        (lambda p: p.with_suffix("").mkdir(), "are the same camera; keep one"),
    ],
)
def test_damaged_videos_are_refused_in_one_line(
    dataset: Path, change: object, message: str
) -> None:
    change(dataset / "cameras" / f"{LEFT}.mp4")  # type: ignore[operator]
    with pytest.raises(CalibrationError, match=re.escape(message)) as caught:
        data = load_dataset(dataset)
        data.frames[0].load_image(LEFT, data.rig.cameras[LEFT])
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_a_calibration_from_a_video_is_that_of_its_images(dataset: Path) -> None:
    result = calibrate(load_dataset(dataset))
    error = evaluate(result.rig, load_rig(SAMPLE / "reference.yaml")).cameras[LEFT]
    assert error.rotation_error_deg < 0.1
    assert error.translation_error_cm < 2.0
