"""The columns of a .bin are those of the rig, or told by its content; otherwise they are asked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from calibgraph import FileError, Rig, load_dataset
from calibgraph.io.clouds import load_cloud, read_cloud
from calibgraph.io.frame import frame_of_entry, load_entry_cloud
from tests.conftest import make_camera

SAMPLE = np.load(Path(__file__).parents[2] / "data" / "sample" / "lidar" / "000000.npy")
ROWS = SAMPLE[: len(SAMPLE) // 60 * 60]  # whole rows of every number of columns
RNG = np.random.default_rng(0)
RING = np.digitize(np.arctan2(ROWS[:, 2], np.hypot(ROWS[:, 0], ROWS[:, 1])), np.linspace(-1, 1, 99))
TIMES = np.linspace(0, 0.1, len(ROWS))
SIX = np.column_stack([ROWS, RING, TIMES]).astype("<f4")


@pytest.mark.parametrize("columns", [3, 4, 5, 6])
@pytest.mark.parametrize("order", [slice(None), RNG.permutation(len(ROWS)), slice(0, None, 5)])
def test_columns_are_told_by_content(order: slice, columns: int, tmp_path: Path) -> None:
    rows = SIX[order, :columns]
    rows.tofile(tmp_path / "cloud.bin")
    expected = np.full((len(rows), 4), np.nan, np.float32)
    expected[:, : min(4, columns)] = rows[:, :4]
    np.testing.assert_array_equal(load_cloud(tmp_path / "cloud.bin"), expected)
    told = read_cloud(tmp_path / "cloud.bin").told
    assert told == "" if columns == 4 else f"{columns} columns by its content" in told


def test_the_columns_of_the_rig_count_and_stay_in_the_result(tmp_path: Path) -> None:
    """By its content this is x y z intensity ring; the rig has another order."""
    rows = SIX[:, [4, 2, 1, 0, 3]]
    for folder in ("lidar", "cameras/front"):
        (tmp_path / folder).mkdir(parents=True)
    rows.tofile(tmp_path / "lidar" / "0.bin")
    (tmp_path / "cameras" / "front" / "0.png").touch()
    columns = ("ring", "z", "y", "x", "intensity")
    Rig(cameras={"front": make_camera()}, cloud_columns=columns).save(tmp_path / "rig.yaml")
    assert yaml.safe_load((tmp_path / "rig.yaml").read_text())["cloud_columns"] == [*columns]
    (frame,) = load_dataset(tmp_path).frames
    for cloud in (frame.load_cloud(), load_entry_cloud(frame.entry())):
        np.testing.assert_array_equal(cloud, ROWS)
    assert frame_of_entry(frame.entry()).columns == [*columns]
    Rig(cameras={"front": make_camera()}).save(tmp_path / "rig.yaml")
    assert "cloud_columns" not in (tmp_path / "rig.yaml").read_text()


@pytest.mark.parametrize(
    ("name", "content", "line"),
    [
        ("odd.bin", ROWS[:5001].tobytes()[:-8], "whole number of points of 4 float32; is it compl"),
        ("other.pcd.bin", ROWS.tobytes(), "4 columns by its content, expected nuScenes' 5"),
        ("turned.bin", np.ascontiguousarray(ROWS.T).tobytes(), "all x first, then all y"),
        ("wide.bin", ROWS.astype("<f8").tobytes(), "write `cloud_columns: .x, y, z, intensity"),
        ("round.bin", np.round(ROWS.astype("<f8") * 8).tobytes(), "cannot be told by its content"),
    ],
)
def test_a_cloud_that_is_not_as_its_name_is_refused(
    name: str, content: bytes, line: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FileError, match=line):
        load_cloud(tmp_path / name)


def test_named_columns_without_an_axis_are_refused(tmp_path: Path) -> None:
    ROWS.tofile(tmp_path / "cloud.bin")
    with pytest.raises(FileError, match="has the fields x y ring a, expected one z"):
        load_cloud(tmp_path / "cloud.bin", columns=("x", "y", "ring", "a"))
