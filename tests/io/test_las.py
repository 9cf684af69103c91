"""Clouds in LAS and LAZ files."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest

from calibgraph import FileError
from calibgraph.io.clouds import load_cloud

STEP_M = 0.001
XYZ = np.random.default_rng(0).uniform(-50, 50, (2000, 3))
INTENSITY = np.arange(2000)


@pytest.fixture(params=[".las", ".laz"])
def path(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = np.full(3, STEP_M), np.array([1.0, 2.0, 3.0])
    file = laspy.LasData(header)
    file.x, file.y, file.z = XYZ.T
    file.intensity = INTENSITY
    path = tmp_path / f"scan{request.param}"
    file.write(path)
    return path


def test_points_are_those_that_were_written(path: Path) -> None:
    cloud = load_cloud(path)
    assert np.abs(cloud[:, :3] - XYZ).max() < STEP_M
    np.testing.assert_array_equal(cloud[:, 3], INTENSITY)


@pytest.mark.parametrize("kept", [2, 100, 1000, -1000])
def test_an_incomplete_file_is_refused(path: Path, kept: int) -> None:
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(FileError, match=r"cannot be read as LAS|truncated") as caught:
        load_cloud(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize("seed", range(4))
def test_a_header_of_noise_is_refused_at_once(tmp_path: Path, seed: int) -> None:
    noise = np.random.default_rng(seed).bytes(400)
    (tmp_path / "scan.las").write_bytes(b"LASF" + noise)
    with pytest.raises(FileError, match="cannot be read as LAS"):
        load_cloud(tmp_path / "scan.las")


def test_a_file_without_points_is_refused(tmp_path: Path) -> None:
    laspy.LasData(laspy.LasHeader(point_format=3, version="1.2")).write(tmp_path / "scan.las")
    with pytest.raises(FileError, match="holds no point"):
        load_cloud(tmp_path / "scan.las")
