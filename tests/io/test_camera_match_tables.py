"""Tables of camera-camera matches from disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from calibgraph import FileError
from calibgraph.io.camera_match_tables import load_camera_matches
from calibgraph.model.camera_matches import COLUMNS, CameraMatches
from tests.model.tables import camera_matches


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_a_file_returns_the_same_table(suffix: str, tmp_path: Path) -> None:
    given = camera_matches()
    path = tmp_path / f"pairs{suffix}"
    given.save(path)
    read = load_camera_matches(path)
    assert read.cameras == given.cameras
    for name in ("camera_index", "frame", "pixels_px", "planes_lidar_per_m"):
        np.testing.assert_array_equal(getattr(read, name), getattr(given, name))
    if suffix == ".parquet":
        assert read.metadata == given.metadata


def test_an_empty_table_keeps_its_cameras(tmp_path: Path) -> None:
    path = tmp_path / "none.parquet"
    CameraMatches.empty(("a", "b")).save(path)
    assert len(load_camera_matches(path)) == 0
    assert load_camera_matches(path).cameras == ("a", "b")


def test_bad_files_are_named(tmp_path: Path) -> None:
    good = camera_matches().to_arrow()
    wrong = {
        "is missing": good.drop_columns(["u_a_px"]),
        "unknown columns": good.append_column("more", pa.array([1, 2, 3])),
        "format": good.replace_schema_metadata({"format": "calibgraph-correspondences/1"}),
        "is empty": good.set_column(0, "camera_a", pa.array(["left", None, "right"])),
        "wrong value": good.set_column(3, "u_a_px", pa.array(["x", "y", "z"])),
        "row 0: planes": good.set_column(
            COLUMNS.index("qx_a_per_m"), "qx_a_per_m", pa.array([None, 1.0, None])
        ),
    }
    for message, table in wrong.items():
        path = tmp_path / "bad.parquet"
        parquet.write_table(table, path)
        with pytest.raises(FileError, match=message):
            load_camera_matches(path)
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(FileError, match="Parquet"):
        load_camera_matches(path)
    with pytest.raises(FileError, match="no such file"):
        load_camera_matches(tmp_path / "nothing.parquet")
