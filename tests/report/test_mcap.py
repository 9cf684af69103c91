"""Recordings for viewers, read back by the format's own reader."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import calibgraph
from calibgraph import (
    Calibration,
    CalibrationError,
    load_dataset,
    load_rig,
    perturb,
    simulate_correspondences,
    solve,
)
from calibgraph.model.geometry import invert
from calibgraph.report.mcap_file import project_cloud
from tests.cli.conftest import error_line
from tests.conftest import SAMPLE, Call

pytest.importorskip("foxglove")
pytest.importorskip("mcap_protobuf")  # reads what foxglove-sdk writes

FRAMES = 2
CAMERA = "left"


@pytest.fixture(scope="module")
def result() -> Calibration:
    """A result of the sample's truth, with two of its frames."""
    truth = load_rig(SAMPLE / "reference.yaml")
    table = simulate_correspondences(truth, frames=5, matches=100)
    solved = solve(perturb(truth, rotation_deg=2, translation_m=0.2, seed=1), table)
    frames = load_dataset(SAMPLE, truth).frames[:FRAMES]
    return replace(solved, frames=tuple(frame.entry() for frame in frames))


def read_mcap(path: Path) -> list[tuple[str, str, int, Any]]:
    """Topic, schema, time [ns] and message."""
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [
            (channel.topic, schema.name, message.log_time, decoded)
            for schema, channel, message, decoded in reader.iter_decoded_messages()
            if schema is not None
        ]


@pytest.fixture(scope="module")
def messages(
    result: Calibration, tmp_path_factory: pytest.TempPathFactory
) -> list[tuple[str, str, int, Any]]:
    return read_mcap(calibgraph.write_mcap(result, tmp_path_factory.mktemp("mcap") / "view.mcap"))


def cloud_of(result: Calibration, number: int) -> np.ndarray:
    cloud = np.load(result.frames[number]["cloud"])[:, :3]
    return cloud[np.isfinite(cloud).all(axis=1)]


def test_mcap_has_cloud_image_lens_and_points(
    messages: list[tuple[str, str, int, Any]], result: Calibration
) -> None:
    assert {stamp for _, _, stamp, _ in messages} == {0, 10**9}  # a second per frame
    second = {topic: message for topic, _, stamp, message in messages if stamp}
    cloud = second["/lidar"]
    offsets = {field.name: field.offset for field in cloud.fields}
    packed = np.frombuffer(cloud.data, np.uint8).reshape(-1, cloud.point_stride)
    x = packed[:, offsets["x"] : offsets["x"] + 4].copy().view("<f4")[:, 0]
    np.testing.assert_array_equal(x, cloud_of(result, 1)[:, 0])
    camera = result.rig.cameras[CAMERA]
    lens = second[f"/{CAMERA}/calibration"]
    assert (lens.width, lens.height, lens.distortion_model) == (640, 360, "plumb_bob")
    np.testing.assert_array_equal(np.reshape(lens.K, (3, 3)), camera.matrix_px)
    assert list(lens.D) == list(camera.distortion)
    image = cv2.imdecode(np.frombuffer(second[f"/{CAMERA}/image"].data, np.uint8), 1)
    assert image.shape == (360, 640, 3)
    for when, rig in (("before", result.initial_rig), ("after", result.rig)):
        (points,) = second[f"/{CAMERA}/{when}"].points
        expected, _ = project_cloud(rig.cameras[CAMERA], cloud_of(result, 1))
        np.testing.assert_allclose([(p.x, p.y) for p in points.points], expected, atol=1e-9)
        assert len(points.outline_colors) == len(expected) > 1000
        assert points.type == points.POINTS


def test_mcap_places_the_optical_frames_in_the_lidar_s(
    messages: list[tuple[str, str, int, Any]], result: Calibration
) -> None:
    (transforms,) = (m for topic, _, stamp, m in messages if topic == "/tf" and stamp)
    found = {}
    for one in transforms.transforms:
        assert one.parent_frame_id == "lidar"
        T = np.eye(4)
        q = one.rotation
        T[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        T[:3, 3] = one.translation.x, one.translation.y, one.translation.z
        found[one.child_frame_id] = T
    for name in result.rig.cameras:
        after, before = found[f"{name}_optical_frame"], found[f"{name}_before"]
        np.testing.assert_allclose(after, invert(result.T_camera_lidar[name]), atol=1e-12)
        guess = result.initial_rig.T_camera_lidar[name]
        np.testing.assert_allclose(before, invert(guess), atol=1e-12)


def test_a_result_without_frames_has_nothing_to_show(result: Calibration, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="names no images and clouds"):
        calibgraph.write_mcap(replace(result, frames=()), tmp_path / "file")
    assert not list(tmp_path.iterdir())


def test_the_command_writes_it_in_place_of_the_page(
    call: Call, result: Calibration, tmp_path: Path
) -> None:
    result.save(tmp_path / "result")
    mcap = tmp_path / "a.mcap"
    code, _, err = call("report", tmp_path / "result", "--mcap", mcap)
    assert code == 0
    assert f"{mcap}: written; the verdict is {result.verdict.status}\n" in err
    assert not (tmp_path / "result" / "report.html").exists()
    assert len(read_mcap(mcap)) == FRAMES * (3 + 4 * len(result.rig.cameras))
    assert "is there already" in error_line(*call("report", tmp_path / "result", "--mcap", mcap))
    said = error_line(*call("report", tmp_path / "result", "--mcap", tmp_path / "a.bag"))
    assert "must end in .mcap" in said
