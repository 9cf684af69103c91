"""One solve over many files: the same result as of one table, whoever holds the files."""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Callable
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest

import calibgraph
from calibgraph import Calibration, Correspondences, MatcherErrors, Rig, perturb
from calibgraph.errors import CalibrationError
from calibgraph.fleet.sharded.quantiles import SpreadValues, count_bins, values_in_bin
from calibgraph.fleet.sharded.solve import solve_sharded, table_files
from calibgraph.fleet.sharded.workers import Engine, start_workers
from calibgraph.model.config import Config, preset
from calibgraph.model.correspondences import concatenate
from calibgraph.model.geometry import twist_between
from calibgraph.simulation.correspondences import simulate_correspondences
from calibgraph.simulation.rigs import rig_of
from calibgraph.solver.residual_scale import robust_spread
from tests.conftest import Call

RIG = rig_of("kitti")


@pytest.fixture(scope="module")
def table() -> Correspondences:
    """Twelve frames with outliers; confidences of which many are equal."""
    made = simulate_correspondences(RIG, frames=12, errors=MatcherErrors(outlier_share=0.2))
    confidence = np.maximum(np.round(made.confidence, 1), 0.1).astype(np.float32)
    return replace(made, confidence=confidence)


@pytest.fixture(scope="module")
def guess() -> Rig:
    return perturb(RIG, rotation_deg=1, translation_m=0.1)


def save_parts(table: Correspondences, folder: Path, parts: int) -> Path:
    folder.mkdir()
    for number, frames in enumerate(np.array_split(np.unique(table.frame), parts)):
        table.select(np.isin(table.frame, frames)).save(folder / f"part{number:03d}.parquet")
    return folder


def require_equal(one: Calibration, other: Calibration) -> None:
    """Equal but for the order of summation; covariances are from differences over 1e-5."""
    for name in one.rig.cameras:
        xi = twist_between(one.T_camera_lidar[name], other.T_camera_lidar[name])
        assert np.abs(xi).max() < 1e-12
        assert astuple(one.residuals[name]) == pytest.approx(
            astuple(other.residuals[name]), rel=1e-12
        )
        assert one.prior_share[name] == pytest.approx(other.prior_share[name], rel=1e-8, abs=1e-12)
    assert one.counts == other.counts
    assert one.joint_covariance is not None
    assert other.joint_covariance is not None
    scale = np.sqrt(np.diag(one.joint_covariance))
    difference = (one.joint_covariance - other.joint_covariance) / np.outer(scale, scale)
    assert np.abs(difference).max() < 1e-8


@pytest.mark.parametrize("name", ["auto", "kitti", "walkley"])
def test_many_files_are_solved_as_one_table(
    table: Correspondences, guess: Rig, tmp_path: Path, name: str
) -> None:
    config = preset(name)
    folder = save_parts(table, tmp_path / "parts", 5)
    found = solve_sharded(guess, folder, config, engine="local")
    require_equal(found, calibgraph.solve(guess, table, config))
    assert found.verdict.status == "PASS"


def test_a_camera_that_a_file_lacks_and_pixels_with_information(
    table: Correspondences, guess: Rig, tmp_path: Path
) -> None:
    some = table.select(~(np.isin(table.frame, table.frame[:1]) & (table.camera_index == 0)))
    spread = np.random.default_rng(0).uniform(0.5, 2.0, (len(some), 1))
    informed = replace(some, information_px=spread * [1.0, 0.0, 1.0])
    folder = save_parts(informed, tmp_path / "parts", 12)
    found = solve_sharded(guess, folder, engine="local")
    require_equal(found, calibgraph.solve(guess, informed))


def test_frames_that_repeat_one_of_another_file_count_once(
    table: Correspondences, guess: Rig, tmp_path: Path
) -> None:
    copy = table.select(table.frame == table.frame.max())
    both = concatenate([table, replace(copy, frame=copy.frame + 1)])
    folder = save_parts(both, tmp_path / "parts", 13)
    found, one = solve_sharded(guess, folder, engine="local"), calibgraph.solve(guess, both)
    require_equal(found, one)
    assert {counts["repeated_frames"] for counts in found.counts.values()} == {1}


@pytest.mark.parametrize("own", [False, True], ids=["all places", "their own"])
def test_places_are_those_of_one_table(
    table: Correspondences, guess: Rig, tmp_path: Path, own: bool
) -> None:
    """Of frames in several files; or every file states those of its frames alone."""
    places = [[0, 1], [2, 3], [4, 5], [6, 7]] if own else [[0, 5, 6], [1, 2, 11], [3, 9]]
    stated = {"systematic_rotation_rad": 1e-3, "systematic_translation_m": 0.01,
              "place_rotation_rad": 7e-4, "place_translation_m": 0.006, "place_variance": 8.0,
              "elevation_rad": 1e-3}  # fmt: skip
    placed = replace(table, metadata={**table.metadata, **stated, "places": places})
    folder = save_parts(placed, tmp_path / "parts", 6)
    for number, path in enumerate(sorted(folder.iterdir()) if own else []):
        part = calibgraph.load_correspondences(path)
        part = replace(part, metadata={**part.metadata, "places": [[2 * number, 2 * number + 1]]})
        path.unlink()
        part.save(path)
    if own:
        places += [[8, 9], [10, 11]]
    one = calibgraph.solve(guess, replace(placed, metadata={**placed.metadata, "places": places}))
    assert one.counts["image_2"]["places"] == (6 if own else 4)
    found = solve_sharded(guess, folder, engine="local")
    require_equal(found, one)


def test_a_frame_in_two_files_is_refused(
    table: Correspondences, guess: Rig, tmp_path: Path
) -> None:
    folder = save_parts(table, tmp_path / "parts", 2)
    table.select(table.frame == table.frame.max()).select(slice(0, 300)).save(
        folder / "part009.parquet"
    )
    with pytest.raises(CalibrationError, match=r"has rows in .*part001.parquet and in .*part009"):
        solve_sharded(guess, folder, engine="local")


def test_any_number_of_workers_gives_the_same_to_the_last_bit(
    table: Correspondences, guess: Rig, tmp_path: Path
) -> None:
    folder = save_parts(table, tmp_path / "parts", 5)
    one, two, five = (solve_sharded(guess, folder, engine="local", workers=n) for n in (1, 2, 5))
    for other in (two, five):
        for name in RIG.cameras:
            assert np.array_equal(one.T_camera_lidar[name], other.T_camera_lidar[name])
        assert np.array_equal(one.joint_covariance, other.joint_covariance)
        assert one.residuals == other.residuals


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["processes", "ray"])
def test_other_processes_give_the_same(
    table: Correspondences, guess: Rig, tmp_path: Path, engine: Engine
) -> None:
    """But for kernels that were compiled apart, which may round differently."""
    if engine == "ray":
        pytest.importorskip("ray")
    folder = save_parts(table, tmp_path / "parts", 5)
    local = solve_sharded(guess, folder, engine="local")
    for workers in (1, 2):
        require_equal(solve_sharded(guess, folder, engine=engine, workers=workers), local)


@pytest.mark.slow
def test_an_error_in_a_worker_is_one_line(guess: Rig, tmp_path: Path) -> None:
    (tmp_path / "bad.parquet").write_bytes(b"no table")
    with pytest.raises(CalibrationError, match="cannot be read as Parquet"):
        solve_sharded(guess, tmp_path, engine="processes")


@pytest.mark.slow
def test_the_death_of_a_worker_is_one_line(
    table: Correspondences, guess: Rig, tmp_path: Path
) -> None:
    folder = save_parts(table, tmp_path / "parts", 2)
    paths = [str(path) for path in table_files(folder)]
    with start_workers(guess, paths, Config(), "processes", 2) as workers:
        workers.call("load")
        multiprocessing.active_children()[0].kill()
        with pytest.raises(CalibrationError, match="a worker of the solve is gone"):
            workers.call("inventory")


def test_order_statistics_of_parts_are_those_of_all() -> None:
    rng = np.random.default_rng(0)
    values = np.concatenate([rng.rayleigh(0.7, 3000), rng.uniform(0, 300, 2000), [0.0, np.inf]])
    parts = np.array_split(rng.permutation(values), 7)
    counts = np.sum([count_bins(part) for part in parts], axis=0)
    fetch: Callable[[int], np.ndarray] = lambda number: np.concatenate(  # noqa: E731
        [values_in_bin(part, number) for part in parts]
    )
    spread = SpreadValues(counts, fetch)
    finite = np.sort(values[np.isfinite(values)])
    assert [spread.at(k) for k in (0, 1, 2500, 5000)] == finite[[0, 1, 2500, 5000]].tolist()
    assert spread.count_up_to(1.0) == np.count_nonzero(finite <= 1.0)
    assert spread.robust_spread == robust_spread(values)
    assert spread.median == pytest.approx(np.median(finite), rel=1e-15)
    assert math.isnan(spread.quantile_below(-0.0, 0.5)) is False


def test_the_command_solves_a_folder(
    table: Correspondences, guess: Rig, tmp_path: Path, call: Call
) -> None:
    guess.save(tmp_path / "rig.yaml")
    folder = save_parts(table, tmp_path / "parts", 3)
    given = (tmp_path / "rig.yaml", folder, "--out", tmp_path / "result")
    assert call("solve", *given, "--engine", "local")[0] == 0
    loaded = calibgraph.load_calibration(tmp_path / "result")
    require = calibgraph.solve(guess, table, Config())
    for name in RIG.cameras:
        xi = twist_between(loaded.T_camera_lidar[name], require.T_camera_lidar[name])
        assert np.abs(xi).max() < 1e-12
    for engine, where in (("spark", folder), ("local", folder / "part000.parquet")):
        code, _, err = call("solve", given[0], where, *given[2:], "--engine", engine)
        assert (code, err.count("\n")) == (2, 1)
