from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from calibgraph import (
    Config,
    CorrespondenceError,
    Correspondences,
    FileError,
    Rig,
    concatenate,
    load_correspondences,
    simulate_correspondences,
)
from calibgraph.io.correspondence_tables import from_arrow
from calibgraph.solver.preprocess import preprocess
from calibgraph.solver.whitening import constrained_error_px, sqrt_information

to_arrow = Correspondences.to_arrow


def table(**changes: Any) -> Correspondences:
    """Four correspondences of two cameras and two frames."""
    columns: dict[str, Any] = {
        "camera": ["left", "left", "right", "left"],
        "frame": [0, 1, 1, 1],
        "pixels_px": [[600, 180], [610, 190], [500, 200], [610.4, 190.3]],
        "points_lidar_m": [[10, 0, 0], [9, 0, 0], [10, -1, 0], [20, 0, 0]],
        "confidence": [0.9, 0.8, 1.0, 0.7],
    }
    return Correspondences.from_arrays(**(columns | changes))


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_a_file_returns_the_same_table(suffix: str, tmp_path: Path) -> None:
    given = table(
        information_px=[[1, 0, 1], [2, 0.5, 1], [1, 1, 1], [4, 0, 0]],
        stamp_ns=[1, 2, 2, 1_700_000_000_123_456_789],
        point_index=[7, -1, 0, 2**40],
        metadata={"matcher": "by hand", "settings": {"k": 1}},
    )
    path = tmp_path / f"table{suffix}"
    given.save(path)
    read = load_correspondences(path)
    assert [read.cameras[i] for i in read.camera_index] == ["left", "left", "right", "left"]
    for name in ("frame", "pixels_px", "points_lidar_m", "confidence", "stamp_ns", "point_index"):
        np.testing.assert_array_equal(getattr(read, name), getattr(given, name))
    np.testing.assert_array_equal(read.information_px, given.information_px)
    if suffix == ".parquet":
        assert read.metadata == given.metadata
        assert parquet.read_schema(path).metadata[b"format"] == b"calibgraph-correspondences/1"


def test_a_table_written_by_another_tool_is_read(tmp_path: Path) -> None:
    """Plain strings, float32, no confidence, no metadata, columns in another order."""
    columns = {
        "x_m": np.float32([1.5, 2]), "y_m": np.float32([0, 1]), "z_m": np.float32([0, 1]),
        "u_px": np.float32([5, 6]), "v_px": np.float32([7, 8]),
        "frame": [3, 4], "camera": ["a", "b"],
    }  # fmt: skip
    path = tmp_path / "table.parquet"
    parquet.write_table(pa.table(columns), path)
    read = load_correspondences(path)
    assert read.points_lidar_m[0].tolist() == [1.5, 0, 0]
    assert read.confidence.tolist() == [1, 1]
    assert read.counts() == {"a": 1, "b": 1}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pixels_px": [[np.nan, 1]] * 4}, r"row 0 \(camera 'left', frame 0\): pixel"),
        ({"points_lidar_m": [[1, 2, np.inf]] * 4}, "point must be finite"),
        ({"confidence": [0.5, 0, 1, 1]}, r"row 1 .*confidence must lie in \(0, 1\]"),
        ({"confidence": [0.5, 1.5, 1, 1]}, "confidence"),
        ({"confidence": [0.5, np.nan, 1, 1]}, "confidence"),
        ({"confidence": [0.5, 1e300, 1, 1]}, r"row 1 .*confidence must lie in \(0, 1\]"),
        ({"information_px": [[1, 2, 1]] * 4}, "positive semidefinite"),
        ({"information_px": [[0, 0, 0]] * 4}, "not zero"),
        ({"pixels_px": [[1e308, 1]] * 4}, "pixel must be finite and below"),
        ({"information_px": [[1e200, 2e200, 1e200]] * 4}, "information must be finite and below"),
        ({"information_px": [[1e-200, 2e-200, 1e-200]] * 4}, "positive semidefinite"),
        ({"frame": [0.5, 1, 1, 1]}, "frame must hold whole numbers"),
        ({"metadata": [1]}, "metadata must be a mapping"),
        (
            {"metadata": {"systematic_rotation_rad": 10**400}},
            "must be a number from 0 to 3.14, found inf",
        ),
        ({"metadata": {"systematic_rotation_rad": -(10**400)}}, "found -inf"),
        ({"metadata": {"range_rotation_deg": "20"}}, "'range_rotation_deg' must be a number from"),
        ({"metadata": {"range_translation_m": math.nan}}, "from 0 to 100, found nan"),
        ({"metadata": {"systematic_translation_m": np.nan}}, "found nan"),
        ({"metadata": {"systematic_translation_m": "1"}}, "found '1'"),
        ({"points_lidar_m": [[1, 2]] * 4}, r"shape \(4, 2\), expected \(4, 3\)"),
        ({"confidence": [1.0]}, "shape"),
    ],
)
def test_bad_values_are_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(CorrespondenceError, match=message):
        table(**changes)


def test_bad_files_are_named(tmp_path: Path) -> None:
    good = tmp_path / "good.parquet"
    table().save(good)
    for name, data in {
        "truncated.parquet": good.read_bytes()[:-200],
        "head.parquet": good.read_bytes()[:100],
        "empty.parquet": b"",
        "text.parquet": b"hello",
        "empty.csv": b"",
        "ragged.csv": b"camera,frame\nleft\n",
        "short.csv": b"camera,frame\nleft,3\n",
        "words.csv": b"camera,frame,u_px,v_px,x_m,y_m,z_m\nleft,zero,1,2,3,4,5\n",
        "half.csv": b"camera,frame,u_px,v_px,x_m,y_m,z_m\nleft,0,1.5,2,3,4,\n",
        "header.csv": b"camera,frame,u_px,v_px,x_m,y_m,z_m\n",
        "twice.csv": b"camera,camera,frame,u_px,v_px,x_m,y_m,z_m\na,a,0,1,2,3,4,5\n",
        "fraction.csv": b"camera,frame,u_px,v_px,x_m,y_m,z_m\nleft,0.5,1,2,3,4,5\n",
    }.items():
        path = tmp_path / name
        path.write_bytes(data)
        with pytest.raises(FileError, match=name) as caught:
            load_correspondences(path)
        assert "\n" not in str(caught.value)
    with pytest.raises(FileError, match="no such file"):
        load_correspondences(tmp_path / "missing.parquet")


def test_a_name_that_no_file_can_have_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="cannot be read .*name too long.*; check the path"):
        load_correspondences(tmp_path / ("x" * 300 + ".parquet"))


def test_unknown_and_missing_columns_are_named(tmp_path: Path) -> None:
    path = tmp_path / "table.parquet"
    arrow = to_arrow(table())
    parquet.write_table(arrow.append_column("weight", pa.array([1.0] * 4)), path)
    with pytest.raises(FileError, match="unknown column 'weight'"):
        load_correspondences(path)
    parquet.write_table(arrow.drop_columns(["u_px"]), path)
    with pytest.raises(FileError, match="column 'u_px' is missing"):
        load_correspondences(path)


def test_tables_of_another_format_or_kind_are_named(tmp_path: Path) -> None:
    path = tmp_path / "table.parquet"
    arrow = to_arrow(table())
    for metadata, message in (
        (
            {"format": "calibgraph-correspondences/9"},
            "has the format 'calibgraph-correspondences/9'",
        ),
        ({"matcher": "not JSON"}, "metadata"),
        ({"matcher": "[1]"}, "metadata must be a mapping"),
        ({"matcher": "[" * 100_000}, "metadata"),
    ):
        parquet.write_table(arrow.replace_schema_metadata(metadata), path)
        with pytest.raises(FileError, match=message) as caught:
            load_correspondences(path)
        assert "\n" not in str(caught.value)
    for name, column in (
        ("camera", pa.array([["a"]] * 4)),
        ("frame", pa.array([True] * 4)),
        ("frame", pa.array([2**63] * 4, pa.uint64())),
        ("u_px", pa.array(["1"] * 4)),
    ):
        index = arrow.column_names.index(name)
        parquet.write_table(arrow.set_column(index, name, column), path)
        with pytest.raises(FileError, match=str(path)) as caught:
            load_correspondences(path)
        assert "\n" not in str(caught.value)


def test_a_whole_number_is_a_systematic_error_as_well(tmp_path: Path) -> None:
    said = {"systematic_rotation_rad": 1, "systematic_translation_m": 0.02}
    table(metadata=said).save(tmp_path / "table.parquet")
    assert load_correspondences(tmp_path / "table.parquet").findings.systematic_sigmas == (
        1.0,
        0.02,
    )


def changed(name: str, column: pa.Array | pa.ChunkedArray, **metadata: str | bytes) -> pa.Table:
    """A good Arrow table with one column, or its metadata, replaced."""
    arrow = to_arrow(table())
    arrow = arrow.set_column(arrow.column_names.index(name), name, column)
    return arrow.replace_schema_metadata(metadata)


FOUR = [1.0] * 4
CAMERAS = pa.array([0, 1, 0, 2])


@pytest.mark.parametrize(
    ("arrow", "message"),
    [
        (to_arrow(table()).drop_columns(["v_px"]), "column 'v_px' is missing"),
        (changed("confidence", pa.array([1, 1e300, 1, 1])), r"row 1 .*lie in \(0, 1\]"),
        (changed("u_px", pa.array([1, None, 1, 1])), "row 1: column 'u_px' is empty"),
        (changed("u_px", pa.nulls(4)), "column 'u_px' is empty; fill in or drop it"),
        (changed("camera", pa.array(["a", "b", None, "c"])), "row 2: column 'camera' is empty"),
        (
            changed("camera", pa.DictionaryArray.from_arrays(CAMERAS, ["a", None, "b"])),
            "row 1: column 'camera' is empty",
        ),
        (
            changed("camera", pa.DictionaryArray.from_arrays(CAMERAS, FOUR)),
            "'camera' must hold text, found dictionary<values=double",
        ),
        (changed("camera", pa.array([b"\xff"] * 4)), "has the wrong type: Invalid UTF8"),
        (changed("frame", pa.array([2**63] * 4, pa.uint64())), "'frame' .* beyond 64 bits"),
        (changed("frame", pa.array(FOUR)), "'frame' must hold whole numbers, found double"),
        (changed("u_px", pa.array(["1"] * 4)), "'u_px' must hold numbers, found string"),
        (
            changed("u_px", pa.RunEndEncodedArray.from_arrays([4], [1.0])),
            "'u_px' must hold numbers, found run_end_encoded",
        ),
        (changed("u_px", pa.array([FOUR] * 4)), "'u_px' must hold numbers, found list"),
        (
            changed("u_px", pa.array(FOUR).dictionary_encode()),
            "'u_px' must hold numbers, found dictionary",
        ),
        (changed("u_px", pa.array([1] * 4, pa.decimal128(3, 1))), "found decimal"),
        (changed("u_px", pa.array([1] * 4, pa.timestamp("s"))), "found timestamp"),
        (
            changed("u_px", pa.array(FOUR), matcher='{"systematic_rotation_rad": -1}'),
            "metadata 'systematic_rotation_rad' must be a number from 0 to 3.14, found -1.0",
        ),
        (
            changed("u_px", pa.array(FOUR), matcher=b'{"a": "\xff"}'),
            "the metadata has the wrong type",
        ),
    ],
)
def test_wrong_arrow_data_is_named_in_one_line(arrow: pa.Table, message: str) -> None:
    with pytest.raises(CorrespondenceError, match=message) as caught:
        from_arrow(arrow)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "cameras",
    [
        pa.array(["left", "left", "right", "left"]).dictionary_encode(),
        pa.array(["left", "left", "right", "left"], pa.large_string()),
        pa.array([b"left", b"left", b"right", b"left"]),
        pa.chunked_array([pa.array(["left", "left"]), pa.array(["right", "left"])]),
        pa.DictionaryArray.from_arrays([0, 1, 3, 0], ["left", "left", None, "right"]),
    ],
)
def test_names_of_cameras_may_be_any_text(cameras: pa.Array | pa.ChunkedArray) -> None:
    read = from_arrow(changed("camera", cameras))
    assert read.counts() == {"left": 3, "right": 1}


def test_a_column_whose_name_is_no_utf8_is_named_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_bytes(b"camera,fr\xffame,u_px,v_px,x_m,y_m,z_m\nleft,1,1,2,3,4,5\n")
    with pytest.raises(FileError, match="table.csv: a column's name is not UTF-8") as caught:
        load_correspondences(path)
    assert "\n" not in str(caught.value)


def test_concatenating_keeps_rows_and_fills_information() -> None:
    one = table()
    two = table(camera="rear", information_px=[[4, 0, 1]] * 4)
    joined = concatenate([one, two])
    assert joined.counts() == {"left": 3, "rear": 4, "right": 1}
    assert joined.information_px[0].tolist() == [1, 0, 1]
    assert joined.information_px[-1].tolist() == [4, 0, 1]
    assert len(joined.of_camera("rear")) == 4
    assert len(joined.of_camera("nobody")) == 0


def test_preprocessing_keeps_the_best_of_each_cell(pair: Rig) -> None:
    kept = preprocess(pair, table(), Config())
    # Rows 1 and 3 share a camera, frame and cell: the more confident one stays.
    assert kept.table.confidence.tolist() == pytest.approx([0.9, 0.8, 1.0])
    assert kept.counts["left"] == {
        "given": 3, "projectable": 3, "confident": 3, "best_in_cell": 2, "capped": 2,
    }  # fmt: skip


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
    kept = preprocess(pair, behind, config)
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


def test_preprocessing_names_an_unknown_camera(pair: Rig) -> None:
    with pytest.raises(CorrespondenceError, match="camera 'rear' of the correspondences"):
        preprocess(pair, table(camera="rear"), Config())


def test_weights_are_the_papers() -> None:
    given = table(confidence=[0.05, 0.25, 1.0, 0.7])
    assert sqrt_information(given, Config()) is None
    roots = sqrt_information(given, Config(confidence_weights=True))
    expected = np.sqrt([0.1, 0.25, 1.0, 0.7])
    np.testing.assert_allclose(roots[:, 0], expected, rtol=1e-6)
    np.testing.assert_allclose(roots[:, 2], expected, rtol=1e-6)
    assert not roots[:, 1].any()


def test_whitening_is_a_root_of_the_information() -> None:
    information = np.array([[4.0, 1.0, 2.0], [1, 1, 1], [0, 0, 9], [9, 0, 0]])
    roots = sqrt_information(table(information_px=information), Config())
    for (uu, uv, vv), (a, b, c) in zip(information, roots, strict=True):
        S = np.array([[a, b], [0, c]])
        np.testing.assert_allclose(S.T @ S, [[uu, uv], [uv, vv]], atol=1e-12)


def test_the_error_of_an_edge_is_the_distance_from_it() -> None:
    residuals = np.array([[3.0, 4.0], [3.0, 4.0], [3.0, 4.0]])
    information = np.array([[1.0, 0, 1], [7.0, 0, 0], [0.5, 0.5, 0.5]])
    expected = [5.0, 3.0, 7 / np.sqrt(2)]
    np.testing.assert_allclose(constrained_error_px(residuals, information), expected)
    np.testing.assert_allclose(constrained_error_px(residuals, None), 5.0)
