"""The filters keep the right rows; weights; the robust spread."""

from collections import Counter
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
from calibgraph.solver import preprocess
from calibgraph.solver.robust import robust_spread, sqrt_information
from tests.model.tables import table as small_table

to_arrow = Correspondences.to_arrow


COLUMNS = (
    "frame", "pixels_px", "points_lidar_m", "confidence", "information_px", "stamp_ns",
)  # fmt: skip


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
        stamp_ns=np.arange(n),
        metadata={"matcher": "simulated", "systematic_rotation_rad": 0.001},
    )


def saved(table: Correspondences, path: Path, **options: Any) -> Path:
    parquet.write_table(to_arrow(table), path, **options)
    return path


def by_hand(
    rig: Rig, table: Correspondences, config: Config
) -> tuple[dict[str, list[int]], dict[str, Counter[str]]]:
    """Per camera the rows that the filters keep, one row after the other (no cap), and counts."""
    counts = {name: Counter[str]() for name in rig.cameras}
    best: dict[tuple[str, int, int, int], int] = {}
    for row in range(len(table)):
        name = table.cameras[table.camera_index[row]]
        camera = rig.cameras[name]
        p = camera.T_camera_lidar @ [*table.points_lidar_m[row], 1.0]
        counts[name]["given"] += 1
        if not camera.lens.project(p[:3])[1][0]:
            continue
        counts[name]["projectable"] += 1
        if table.confidence[row] < np.float32(config.confidence_min):
            continue
        counts[name]["confident"] += 1
        u, v = table.pixels_px[row] + 0.5
        column = min(max(int(np.floor(u / camera.width_px * config.grid_columns)), 0), 39)
        line = min(max(int(np.floor(v / camera.height_px * config.grid_rows)), 0), 24)
        key = (name, int(table.frame[row]), column, line)
        if key not in best or table.confidence[row] > table.confidence[best[key]]:
            best[key] = row
    kept: dict[str, list[int]] = {name: [] for name in rig.cameras}
    for (name, *_), row in best.items():
        kept[name].append(row)
        counts[name]["best_in_cell"] += 1
    return kept, counts


def test_preprocessing_keeps_what_is_kept_by_hand(mixed_rig: Rig) -> None:
    table, config = shuffled(mixed_rig, 1), Config(confidence_min=0.4)
    kept = preprocess.preprocess(mixed_rig, table, config)
    by_camera, counts = by_hand(mixed_rig, table, config)
    for name, rows in by_camera.items():
        order = sorted(rows, key=lambda row: (table.frame[row], row))
        assert kept.table.of_camera(name).stamp_ns.tolist() == order
        assert counts[name].items() <= kept.counts[name].items()


def test_a_solve_of_a_file_is_that_of_the_table_to_the_last_bit(pair: Rig, tmp_path: Path) -> None:
    errors = MatcherErrors(noise_px=1.0, frame_noise_px=0.3, outlier_share=0.2)
    table = simulate_correspondences(pair, frames=6, matches=300, errors=errors)
    path = saved(table, tmp_path / "table.parquet")
    one, other = (calibgraph.solve(pair, given) for given in (path, table))
    for name in pair.cameras:
        np.testing.assert_array_equal(one.T_camera_lidar[name], other.T_camera_lidar[name])
        np.testing.assert_array_equal(one.covariance[name], other.covariance[name])
    assert one.verdict == other.verdict
    assert one.counts == other.counts


def test_a_bad_row_of_a_file_is_named(pair: Rig, tmp_path: Path) -> None:
    row = 1296
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


def test_the_cap_keeps_the_most_confident_of_every_frame(pair: Rig) -> None:
    given = simulate_correspondences(pair, frames=3, matches=400)
    config = Config(confidence_min=0.5, matches_max=100)
    kept = preprocess.preprocess(pair, given, config)
    assert kept.counts["left"]["capped"] == 300
    assert np.bincount(kept.table.of_camera("left").frame).tolist() == [100, 100, 100]
    assert kept.table.confidence.min() > config.confidence_min + 0.1


def test_weights_are_the_papers() -> None:
    given = small_table(confidence=[0.05, 0.25, 1.0, 0.7])
    assert sqrt_information(given, Config()) is None
    roots = sqrt_information(given, Config(confidence_weights=True))
    expected = np.sqrt([0.1, 0.25, 1.0, 0.7])
    np.testing.assert_allclose(roots[:, 0], expected, rtol=1e-6)
    np.testing.assert_allclose(roots[:, 2], expected, rtol=1e-6)
    assert not roots[:, 1].any()


def test_whitening_is_a_root_of_the_information() -> None:
    information = np.array([[4.0, 1.0, 2.0], [1, 1, 1], [0, 0, 9], [9, 0, 0]])
    roots = sqrt_information(small_table(information_px=information), Config())
    for (uu, uv, vv), (a, b, c) in zip(information, roots, strict=True):
        S = np.array([[a, b], [0, c]])
        np.testing.assert_allclose(S.T @ S, [[uu, uv], [uv, vv]], atol=1e-12)


def test_the_spread_of_a_core_is_found_under_a_broad_background() -> None:
    rng = np.random.default_rng(0)
    for inliers in (1.0, 0.6, 0.3):
        core = np.hypot(*rng.standard_normal((2, 4000))) / 1.17741
        values = np.concatenate([core, rng.uniform(0, 300, round(4000 * (1 / inliers - 1)))])
        assert robust_spread(values) == pytest.approx(1.0, rel=0.05)
    # Values without a core have the spread of all of them.
    assert robust_spread(rng.uniform(0, 300, 4000)) == pytest.approx(150, rel=0.05)
    assert robust_spread(np.zeros(10)) == 0.0
