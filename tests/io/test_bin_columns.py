"""The columns of a .bin are told by its content; what contradicts its name is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from calibgraph import FileError
from calibgraph.io.clouds import load_cloud, read_cloud

SAMPLE = np.load(Path(__file__).parents[2] / "data" / "sample" / "lidar" / "000000.npy")
ROWS = SAMPLE[: len(SAMPLE) // 60 * 60]  # whole rows of every number of columns
RNG = np.random.default_rng(0)
RING = np.digitize(np.arctan2(ROWS[:, 2], np.hypot(ROWS[:, 0], ROWS[:, 1])), np.linspace(-1, 1, 99))
TIMES = np.linspace(0, 0.1, len(ROWS))
COLUMNS = {
    3: ROWS[:, :3],
    4: ROWS,
    5: np.column_stack([ROWS, RING]),
    6: np.column_stack([ROWS, RING, TIMES]),
}


@pytest.mark.parametrize("dtype", ["<f4", "<f8"])
@pytest.mark.parametrize("columns", [3, 4, 5, 6])
@pytest.mark.parametrize("order", ["scanned", "shuffled", "part", "thinned"])
def test_columns_and_type_are_told_by_content(
    order: str, columns: int, dtype: str, tmp_path: Path
) -> None:
    chosen = {
        "scanned": slice(None), "shuffled": RNG.permutation(len(ROWS)),
        "part": slice(0, 3000), "thinned": slice(0, None, 5),
    }[order]  # fmt: skip
    rows = COLUMNS[columns].astype(dtype)[chosen]
    rows.tofile(tmp_path / "cloud.bin")
    expected = np.full((len(rows), 4), np.nan, np.float32)
    expected[:, : min(4, columns)] = rows[:, :4]
    np.testing.assert_array_equal(load_cloud(tmp_path / "cloud.bin"), expected)
    told = read_cloud(tmp_path / "cloud.bin").told
    assert told == "" if (columns, dtype) == (4, "<f4") else f"{columns} float" in told


def test_float64_of_few_digits_are_no_float32(tmp_path: Path) -> None:
    rows = np.round(ROWS.astype(np.float64) * 8) / 8
    rows.tofile(tmp_path / "cloud.bin")
    np.testing.assert_array_equal(load_cloud(tmp_path / "cloud.bin"), rows[rows[:, :3].any(axis=1)])


@pytest.mark.parametrize("missing", [4, 8, 12])
def test_a_truncated_cloud_is_not_one_of_other_columns(missing: int, tmp_path: Path) -> None:
    """In one of the three, the rest is whole rows of three columns."""
    for count in (5000, 5001, 5002):
        (tmp_path / "cloud.bin").write_bytes(ROWS[:count].tobytes()[:-missing])
        with pytest.raises(FileError, match="whole number of points of 4 float32 .*complete"):
            load_cloud(tmp_path / "cloud.bin")


def test_a_name_of_nuscenes_that_the_content_contradicts_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cloud.pcd.bin"
    COLUMNS[5].astype("<f4").tofile(path)
    np.testing.assert_array_equal(load_cloud(path), ROWS)
    ROWS.tofile(path)
    with pytest.raises(FileError, match=r"points of 4 float32 .* expected .* nuScenes"):
        load_cloud(path)


@pytest.mark.parametrize("columns", [3, 4])
@pytest.mark.parametrize("dtype", ["<f4", "<f8"])
def test_a_transposed_cloud_is_refused(columns: int, dtype: str, tmp_path: Path) -> None:
    np.ascontiguousarray(COLUMNS[columns].astype(dtype).T).tofile(tmp_path / "cloud.bin")
    with pytest.raises(FileError, match="all x first, then all y"):
        load_cloud(tmp_path / "cloud.bin")


def test_few_points_and_like_columns_are_as_the_name_says(tmp_path: Path) -> None:
    likes: list[NDArray[np.float32]] = [ROWS[:60], RNG.normal(size=(6000, 4)).astype(np.float32)]
    for rows in likes:
        rows.tofile(tmp_path / "cloud.bin")
        np.testing.assert_array_equal(load_cloud(tmp_path / "cloud.bin"), rows)
