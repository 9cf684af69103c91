"""The examples of the README and of the pages, run."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import calibgraph
from calibgraph.matching.structure.schedule import LEVELS
from tests.conftest import ROOT, SAMPLE


def example(page: str) -> str:
    """The one block of Python on a page."""
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), flags=re.DOTALL)
    return str(block)


FIRST = example("README.md")
ARRAYS = example("docs/library.md")
OWN_MATCHER = example("docs/matchers.md")
TRACKER = example("docs/tracking.md")
TRUTH = calibgraph.load_rig(SAMPLE / "reference.yaml")


def arrays_of_sample() -> dict[str, object]:
    """What the example with arrays takes from the reader's program."""
    dataset = calibgraph.load_dataset(SAMPLE)
    cameras = dataset.rig.cameras
    return {
        "clouds": [frame.load_cloud() for frame in dataset.frames],
        "images": {n: [f.load_image(n, c) for f in dataset.frames] for n, c in cameras.items()},
        "size": (640, 360),
        "K": {name: camera.matrix_px for name, camera in cameras.items()},
        "distortion": {name: camera.distortion for name, camera in cameras.items()},
        "T_guess": dataset.rig.T_camera_lidar,
    }


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the examples are run."""
    folder = tmp_path_factory.mktemp("readme")
    (folder / "data").symlink_to(ROOT / "data")
    return folder


@pytest.fixture(scope="module")
def result(folder: Path) -> calibgraph.Calibration:
    """The sample as the README's example calibrates it, from 2 deg and 0.2 m."""
    names: dict[str, object] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        exec(compile(FIRST, "README.md", "exec"), names)
    result = names["result"]
    assert isinstance(result, calibgraph.Calibration)
    return result


def test_the_sample_is_calibrated(result: calibgraph.Calibration, folder: Path) -> None:
    """With exact truth, to the resolution of a 640 px image."""
    for name, error in calibgraph.evaluate(result.rig, TRUTH).cameras.items():
        assert error.rotation_error_deg < 0.12, name  # 1 px is 0.12 deg
        assert error.translation_error_cm < 3, name
    assert result.verdict.status == "PASS", result.verdict.reasons
    assert len(result.rounds) == len(LEVELS) - 3  # the search has done the first
    assert (folder / "out" / "python" / "calibration.yaml").is_file()


@pytest.mark.slow
def test_arrays_give_the_numbers_of_the_folder(
    monkeypatch: pytest.MonkeyPatch, result: calibgraph.Calibration, folder: Path
) -> None:
    monkeypatch.chdir(folder)
    names = arrays_of_sample()
    exec(compile(ARRAYS, "library.md", "exec"), names)
    same = names["result"]
    assert isinstance(same, calibgraph.Calibration)
    for name, T in result.T_camera_lidar.items():
        np.testing.assert_allclose(same.T_camera_lidar[name], T, atol=1e-9)


def test_the_table_of_the_last_round_repeats_the_solve(result: calibgraph.Calibration) -> None:
    assert result.correspondences is not None
    seen = result.camera_matches
    again = calibgraph.solve(result.rig, result.correspondences, camera_matches=seen)
    for name, T in result.T_camera_lidar.items():
        delta = calibgraph.evaluate(again.rig, result.rig).cameras[name]
        # A hundredth of a standard deviation (0.1 deg, 1 cm): the prior is about this result now.
        assert delta.rotation_error_deg < 1e-3, name
        assert delta.translation_error_cm < 1e-2, name
        assert T.shape == (4, 4)


@pytest.mark.usefixtures("no_image_checks")
def test_a_matcher_and_a_tracker_as_in_the_examples(
    monkeypatch: pytest.MonkeyPatch, folder: Path
) -> None:
    monkeypatch.chdir(folder)
    names: dict[str, object] = {"calibgraph": calibgraph, "your_matches": true_matches}
    exec(compile(OWN_MATCHER, "matchers.md", "exec"), names)
    table = calibgraph.load_correspondences(folder / "matches.parquet")
    assert table.point_index is not None and len(np.unique(table.frame)) == 6
    result = names["result"]
    assert isinstance(result, calibgraph.Calibration)
    for error in calibgraph.evaluate(result.rig, TRUTH).cameras.values():
        assert error.rotation_error_deg < 0.1
    names["frame_tables"] = [table.select(table.frame == frame) for frame in range(6)]
    exec(compile(TRACKER, "tracking.md", "exec"), names)
    update = names["update"]
    assert isinstance(update, calibgraph.Update)
    assert update.verdicts["left"].status in ("PASS", "WARN")
    assert calibgraph.IncrementalCalibrator.load("out/tracker").frame == 5


def true_matches(
    image: np.ndarray, cloud: np.ndarray, camera: calibgraph.Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A matcher with errors of half a pixel about the truth."""
    (name,) = [
        n
        for n, c in calibgraph.load_rig(SAMPLE).cameras.items()
        if np.array_equal(c.T_camera_lidar, camera.T_camera_lidar)
    ]
    T = TRUTH.T_camera_lidar[name]
    rng = np.random.default_rng(len(cloud))
    rows = rng.permutation(len(cloud))[:3000]
    points = cloud[rows, :3].astype(np.float64)
    pixels, valid = camera.lens.project(points @ T[:3, :3].T + T[:3, 3])
    seen = valid & camera.in_image(pixels)
    noisy = pixels[seen] + rng.normal(0, 0.5, (np.count_nonzero(seen), 2))
    return noisy, rows[seen], np.ones(len(noisy))


def test_the_rig_example_is_a_rig(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "files.md").read_text()
    text = re.search(r"(format: calibgraph-rig/1\n.*?\n)relative_poses", page, re.DOTALL)
    assert text is not None
    (tmp_path / "rig.yaml").write_text(text[1])
    assert list(calibgraph.load_rig(tmp_path / "rig.yaml").cameras) == ["front"]
