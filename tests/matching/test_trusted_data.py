"""Recordings to learn from: from trusted extrinsics only, split without overlap."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from calibgraph import Dataset, DatasetError, load_rig
from calibgraph.io.calibrations import load_calibration
from calibgraph.matching.trusted_data import load_trusted_dataset, split
from tests.conftest import SAMPLE, CommandRun


@pytest.fixture(scope="module")
def trusted() -> Dataset:
    return load_trusted_dataset(SAMPLE)


def test_the_reference_is_trusted_and_not_the_guess(trusted: Dataset, tmp_path: Path) -> None:
    truth = load_rig(SAMPLE / "reference.yaml").T_camera_lidar
    for name, T in trusted.rig.T_camera_lidar.items():
        np.testing.assert_array_equal(T, truth[name])
    folder = tmp_path / "data"
    shutil.copytree(SAMPLE, folder)
    (folder / "reference.yaml").unlink()
    with pytest.raises(DatasetError, match="a rig.yaml is a guess"):
        load_trusted_dataset(folder)
    assert load_trusted_dataset(folder, trusted.rig).rig == trusted.rig


def test_a_result_is_trusted_where_it_is_pass(
    calibrated_sample: CommandRun, tmp_path: Path
) -> None:
    folder = calibrated_sample.folder
    result = load_calibration(folder)
    passed = {n for n, verdict in result.camera_verdicts.items() if verdict.status == "PASS"}
    assert passed
    data = load_trusted_dataset(folder)
    assert data.rig.cameras.keys() == passed and data.folders == (SAMPLE,)
    assert [frame.entry() for frame in data.frames] == list(result.frames)
    for name in passed:
        np.testing.assert_array_equal(
            data.rig.T_camera_lidar[name], result.rig.T_camera_lidar[name]
        )


def rewritten(folder: Path, to: Path, change: Callable[[dict[str, Any], str], object]) -> Path:
    """A copy of a result whose content is changed, by the path of its first cloud."""
    shutil.copytree(folder, to)
    content = yaml.safe_load((to / "calibration.yaml").read_text())
    change(content, content["frames_used"][0]["cloud"])
    (to / "calibration.yaml").write_text(yaml.safe_dump(content))
    return to


def with_relative_paths(content: dict[str, Any], _: str) -> None:
    def relative(path: str) -> str:
        return str(Path(path).relative_to(SAMPLE.parent))

    content["inputs"] = {relative(path): known for path, known in content["inputs"].items()}
    for frame in content["frames_used"]:
        frame["cloud"] = relative(frame["cloud"])
        frame["images"] = {name: relative(path) for name, path in frame["images"].items()}


def moved_away(content: dict[str, Any], cloud: str) -> None:
    content["frames_used"][0]["cloud"] = f"{cloud}.gone"
    content["inputs"][f"{cloud}.gone"] = content["inputs"].pop(cloud)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c, p: c["inputs"].update({p: "0" * 64}), "has changed since it was calibrated"),
        (
            lambda c, p: c["inputs"].pop(p),
            "lists no hash of .*000000.npy, which may have changed; calibrate again",
        ),
        (moved_away, r"result: its file .*\.gone cannot be read \(No such file.*put the recording"),
        (
            with_relative_paths,
            r"result: its file sample/.*\(No such.*start this in the folder where",
        ),
    ],
)
def test_files_that_are_not_those_of_the_result_are_refused(
    calibrated_sample: CommandRun, tmp_path: Path, change: Callable[..., object], message: str
) -> None:
    folder = rewritten(calibrated_sample.folder, tmp_path / "result", change)
    with pytest.raises(DatasetError, match=message):
        load_trusted_dataset(folder)


def test_a_result_with_relative_paths_is_read_where_it_was_made(
    calibrated_sample: CommandRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = rewritten(calibrated_sample.folder, tmp_path / "result", with_relative_paths)
    monkeypatch.chdir(SAMPLE.parent)
    assert len(load_trusted_dataset(folder).frames) == 6


def test_frames_are_split_at_the_end(trusted: Dataset) -> None:
    (first,), (last,) = split([trusted])
    assert [f.index for f in first.frames] == [0, 1, 2, 3, 4]
    assert [f.index for f in last.frames] == [5]
    with pytest.raises(DatasetError, match="--held-out"):
        split([trusted.select("0")])
