"""Clouds from disk: what is incomplete or no cloud is refused by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibgraph import FileError
from calibgraph.io.clouds import load_cloud

CLOUD = np.random.default_rng(0).normal(size=(500, 4)).astype(np.float32)


def test_npy_and_bin_clouds_are_read(tmp_path: Path) -> None:
    np.save(tmp_path / "four.npy", CLOUD)
    np.save(tmp_path / "three.npy", CLOUD[:, :3].astype(np.float64))
    CLOUD.tofile(tmp_path / "four.bin")
    np.testing.assert_array_equal(load_cloud(tmp_path / "four.npy"), CLOUD)
    np.testing.assert_array_equal(load_cloud(tmp_path / "four.bin"), CLOUD)
    three = load_cloud(tmp_path / "three.npy")
    np.testing.assert_array_equal(three[:, :3], CLOUD[:, :3])
    assert np.isnan(three[:, 3]).all()


def test_rows_without_a_return_are_left_out(tmp_path: Path) -> None:
    organised = CLOUD.copy()
    organised[::5, :3] = np.nan
    np.save(tmp_path / "cloud.npy", organised)
    assert len(load_cloud(tmp_path / "cloud.npy")) == 400


def test_bad_clouds_are_named(tmp_path: Path) -> None:
    good = tmp_path / "good.npy"
    np.save(good, CLOUD)
    partly = CLOUD.copy()
    partly[7, 1] = np.inf
    np.save(tmp_path / "infinite.npy", partly)
    np.save(tmp_path / "flat.npy", CLOUD.ravel())
    np.save(tmp_path / "text.npy", np.array(["a", "b"]))
    np.save(tmp_path / "objects.npy", np.array([{}, None], dtype=object), allow_pickle=True)
    np.save(tmp_path / "nothing.npy", np.full((3, 4), np.nan))
    (tmp_path / "truncated.npy").write_bytes(good.read_bytes()[:-100])
    (tmp_path / "empty.npy").write_bytes(b"")
    (tmp_path / "odd.bin").write_bytes(b"12345")
    (tmp_path / "empty.bin").write_bytes(b"")
    (tmp_path / "cloud.las").write_bytes(b"LASF")
    np.savez(tmp_path / "archive.npz", CLOUD)
    (tmp_path / "archive.npz").rename(tmp_path / "archive.npy")
    np.save(tmp_path / "transposed.npy", np.tile(CLOUD, (20, 1)).T)
    np.save(tmp_path / "origin.npy", np.zeros((100, 4)))
    for path in sorted(set(tmp_path.iterdir()) - {good}):
        with pytest.raises(FileError, match=path.name) as caught:
            load_cloud(path)
        assert "\n" not in str(caught.value)
    with pytest.raises(FileError, match=r"point 7 is not finite"):
        load_cloud(tmp_path / "infinite.npy")


@pytest.mark.parametrize("ascii_format", [True, False])
@pytest.mark.parametrize("suffix", [".pcd", ".ply"])
def test_pcd_and_ply_clouds_are_read_or_refused(
    suffix: str, ascii_format: bool, tmp_path: Path
) -> None:
    open3d = pytest.importorskip(
        "open3d", reason="open3d or a system library of it is missing", exc_type=ImportError
    )
    cloud = open3d.t.geometry.PointCloud(open3d.core.Tensor(CLOUD[:, :3].copy()))
    cloud.point["intensity"] = open3d.core.Tensor(CLOUD[:, 3:].copy())
    path = tmp_path / f"cloud{suffix}"
    open3d.t.io.write_point_cloud(str(path), cloud, write_ascii=ascii_format)
    np.testing.assert_allclose(load_cloud(path), CLOUD, rtol=1e-5, atol=1e-6)
    data = path.read_bytes()
    # Open3D itself reads half a file and fills up with what is in memory: that must not pass.
    for part in (data[: len(data) // 2], data[:-30], data[:60], b""):
        path.write_bytes(part)
        with pytest.raises(FileError, match=path.name):
            load_cloud(path)
