"""The filters keep the right rows; a table in parts gives what the whole table gives."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyarrow import parquet

import calibgraph
from calibgraph import (
    Config,
    Correspondences,
    FileError,
    MatcherErrors,
    Rig,
    simulate_correspondences,
)
from calibgraph.io import correspondence_tables
from calibgraph.solver import preprocess
from calibgraph.solver.preprocess import Preprocessed

to_arrow = Correspondences.to_arrow


COLUMNS = (
    "frame", "pixels_px", "points_lidar_m", "confidence", "information_px", "stamp_ns",
    "point_index",
)  # fmt: skip


SMALL_PART, FEW_MERGED = 257, 300


@pytest.fixture
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parts so small that frames are split and what is kept is merged again and again."""
    monkeypatch.setattr(correspondence_tables, "_PART_ROWS", SMALL_PART)
    monkeypatch.setattr(preprocess, "_MERGED_ROWS", FEW_MERGED)


def shuffled(rig: Rig, seed: int) -> Correspondences:
    """Rows of all frames in any order, with every column, and many of equal confidence.

    Some points lie behind the camera, some confidences below the least, some pixels outside.
    """
    rng = np.random.default_rng(seed)
    given = simulate_correspondences(rig, frames=4, matches=900, seed=seed)
    n = len(given)
    rows = rng.permutation(n)
    points = np.where(rng.random((n, 1)) < 0.1, -1.0, 1.0) * given.points_lidar_m
    root = rng.uniform(0.1, 2, (n, 2))
    return Correspondences.from_arrays(
        camera=np.array(given.cameras)[given.camera_index][rows],
        frame=given.frame[rows] * 10**12 - 7,
        pixels_px=(given.pixels_px + rng.normal(0, 30, (n, 2)))[rows],
        points_lidar_m=points[rows],
        confidence=rng.integers(1, 6, n) / 5,
        information_px=np.column_stack([root[:, 0], np.zeros(n), root[:, 1]]),
        stamp_ns=rng.integers(0, 2**60, n),
        point_index=np.arange(n),
        metadata={"matcher": "simulated", "systematic_rotation_rad": 0.001},
    )


def saved(table: Correspondences, path: Path, **options: Any) -> Path:
    parquet.write_table(to_arrow(table), path, **options)
    return path


def by_hand(rig: Rig, table: Correspondences, config: Config) -> dict[str, list[int]]:
    """Per camera the rows that the filters keep, one row after the other (no cap)."""
    best: dict[tuple[str, int, int, int], int] = {}
    for row in range(len(table)):
        name = table.cameras[table.camera_index[row]]
        camera = rig.cameras[name]
        p = camera.T_camera_lidar @ [*table.points_lidar_m[row], 1.0]
        seen = camera.lens.project(p[:3])[1][0]
        if not seen or table.confidence[row] < np.float32(config.confidence_min):
            continue
        u, v = table.pixels_px[row] + 0.5
        column = min(max(int(np.floor(u / camera.width_px * config.grid_columns)), 0), 39)
        line = min(max(int(np.floor(v / camera.height_px * config.grid_rows)), 0), 24)
        key = (name, int(table.frame[row]), column, line)
        if key not in best or table.confidence[row] > table.confidence[best[key]]:
            best[key] = row
    kept: dict[str, list[int]] = {name: [] for name in rig.cameras}
    for (name, *_), row in best.items():
        kept[name].append(row)
    return kept


def assert_same(found: Preprocessed, expected: Preprocessed) -> None:
    assert found.counts == expected.counts
    assert found.table.metadata == expected.table.metadata
    names = [[t.cameras[i] for i in t.camera_index] for t in (found.table, expected.table)]
    assert names[0] == names[1]
    for column in COLUMNS:
        np.testing.assert_array_equal(
            getattr(found.table, column), getattr(expected.table, column), err_msg=column
        )


def test_preprocessing_keeps_what_is_kept_by_hand(mixed_rig: Rig) -> None:
    table, config = shuffled(mixed_rig, 1), Config(confidence_min=0.4)
    kept = preprocess.preprocess(mixed_rig, table, config)
    for name, rows in by_hand(mixed_rig, table, config).items():
        order = sorted(rows, key=lambda row: (table.frame[row], row))
        assert kept.table.of_camera(name).point_index.tolist() == order
        assert kept.counts[name]["best_in_cell"] == len(rows)


@pytest.mark.usefixtures("small_parts")
@pytest.mark.parametrize("matches_max", [10_000, 150])
@pytest.mark.parametrize("row_group_size", [100, 1000, 10**6])
@pytest.mark.parametrize("seed", [2, 3])
def test_a_file_in_parts_gives_what_the_whole_table_gives(
    mixed_rig: Rig, tmp_path: Path, seed: int, row_group_size: int, matches_max: int
) -> None:
    table = shuffled(mixed_rig, seed)
    config = Config(confidence_min=0.4, matches_max=matches_max)
    path = saved(table, tmp_path / "table.parquet", row_group_size=row_group_size)
    found = preprocess.preprocess(mixed_rig, path, config)
    assert_same(found, preprocess.preprocess(mixed_rig, table, config))
    if matches_max == 150:  # the cap took some: of every camera, 4 frames have 150 left
        assert [c["capped"] for c in found.counts.values()] == [600] * 3


@pytest.mark.usefixtures("small_parts")
def test_a_solve_of_a_file_is_that_of_the_table_to_the_last_bit(pair: Rig, tmp_path: Path) -> None:
    errors = MatcherErrors(noise_px=1.0, frame_noise_px=0.3, outlier_share=0.2)
    table = simulate_correspondences(pair, frames=6, matches=300, errors=errors)
    path = saved(table, tmp_path / "table.parquet")
    config = Config(bootstrap=5)
    one, other = (calibgraph.solve(pair, given, config) for given in (path, table))
    for name in pair.cameras:
        np.testing.assert_array_equal(one.T_camera_lidar[name], other.T_camera_lidar[name])
        np.testing.assert_array_equal(one.covariance[name], other.covariance[name])
    assert one.verdict == other.verdict
    assert one.counts == other.counts


@pytest.mark.usefixtures("small_parts")
@pytest.mark.parametrize("row", [3, SMALL_PART, 5 * SMALL_PART + 11])
def test_a_bad_row_is_counted_from_the_beginning_of_the_file(
    pair: Rig, tmp_path: Path, row: int
) -> None:
    arrow = to_arrow(simulate_correspondences(pair, frames=4, matches=300))
    index = arrow.column_names.index("u_px")
    for bad, message in (
        (np.nan, rf"table.parquet: row {row} \(camera '\w+', frame \d\): pixel must be finite"),
        (None, rf"table.parquet: row {row}: column 'u_px' is empty"),
    ):
        values = arrow["u_px"].to_pylist()
        values[row] = bad
        changed = arrow.set_column(index, "u_px", [values])
        parquet.write_table(changed, tmp_path / "table.parquet")
        with pytest.raises(FileError, match=message):
            calibgraph.solve(pair, tmp_path / "table.parquet")


@pytest.mark.usefixtures("small_parts")
def test_memory_does_not_grow_with_the_table(pair: Rig) -> None:
    """Four times the rows of the same frames may take no more memory, but for the allocator."""
    part = simulate_correspondences(pair, frames=2, matches=4000)

    def parts(count: int) -> Iterator[Correspondences]:
        rng = np.random.default_rng(count)
        for _ in range(count):
            yield part.select(rng.permutation(len(part)))

    def peak_bytes(count: int) -> int:
        tracemalloc.start()
        kept = preprocess.preprocess_parts(pair, parts(count), Config())
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert sum(c["given"] for c in kept.counts.values()) == count * len(part)
        return peak

    peak_bytes(2)  # compiles
    assert peak_bytes(24) < 1.1 * peak_bytes(6)


def test_preprocessing_counts_at_every_filter(pair: Rig) -> None:
    given = simulate_correspondences(pair, frames=3, matches=400)
    points = given.points_lidar_m.copy()
    points[:50] *= -1  # behind the camera
    behind = Correspondences.from_arrays(
        camera=np.array(given.cameras)[given.camera_index],
        frame=given.frame,
        pixels_px=given.pixels_px,
        points_lidar_m=points,
        confidence=given.confidence,
    )
    config = Config(confidence_min=0.5, matches_max=100)
    kept = preprocess.preprocess(pair, behind, config)
    counts = kept.counts["left"]
    assert counts["given"] == 1200
    assert counts["projectable"] == 1150
    assert counts["confident"] == np.count_nonzero(behind.of_camera("left").confidence[50:] >= 0.5)
    assert counts["best_in_cell"] < counts["confident"]
    assert counts["capped"] == 300
    per_frame = np.bincount(kept.table.of_camera("left").frame)
    assert per_frame.tolist() == [100, 100, 100]
    # The cap keeps the most confident.
    assert kept.table.confidence.min() > config.confidence_min + 0.1
