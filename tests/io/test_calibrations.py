"""Results from disk: a file with a wrong part is refused when it is read, in one line."""

import errno
from copy import deepcopy
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml

from calibgraph import FileError, load_calibration, load_correspondences, load_rig
from calibgraph.io.calibrations import stated_result
from calibgraph.report.html import write_result
from tests.conftest import CommandRun

WRONG: dict[str, Any] = {
    "covariance": {"left": [[1.0]]},
    "joint_covariance": [[1.0]],
    "pair_covariance": {"left->right": [[float("nan")] * 6] * 6},
    "stage1_T_camera_lidar": {"left": [[1.0]]},
    "camera_verdicts": {},
    "residuals": {"left": {"median_px": "large"}},
    "weaknesses": {"left": 5},
    "frames_used": [1, 2],
    "rounds": [["a"]],
    "counts": {"left": {"used": "many"}},
    "timings_s": {"solve": "long"},
    "terms": "all",
    "inputs": 3,
    "versions": [1],
    "config": [1],
    "rig": 5,
}


@pytest.mark.parametrize(
    ("key", "number"),
    [
        *(("covariance", number) for number in (float("inf"), float("nan"), 1e308, -1e308)),
        *((key, 1e308) for key in ("timings_s", "residuals", "rounds", "error_sources")),
    ],
)
def test_numbers_that_no_measurement_has_are_refused(
    key: str, number: float, calibrated_sample: CommandRun, tmp_path: Path
) -> None:
    def first_number(part: Any) -> tuple[Any, Any]:
        """The list or mapping, and the place in it, of the first number below a part."""
        for place, value in part.items() if isinstance(part, dict) else enumerate(part):
            if isinstance(value, float):
                return part, place
            if isinstance(value, (dict, list)) and value:
                return first_number(value)
        raise AssertionError

    part = content_of(calibrated_sample)[key]
    owner, place = first_number(part)
    owner[place] = number
    path = edited({key: part}, calibrated_sample, tmp_path)
    with pytest.raises(FileError, match=f"{key}.*no number of a result"):
        load_calibration(path)


@pytest.mark.parametrize("key", WRONG)
def test_a_wrong_part_is_named(key: str, calibrated_sample: CommandRun, tmp_path: Path) -> None:
    path = edited({key: WRONG[key]}, calibrated_sample, tmp_path)
    with pytest.raises(FileError, match=key) as caught:
        load_calibration(path)
    assert "\n" not in str(caught.value)


def test_a_missing_part_is_named(calibrated_sample: CommandRun, tmp_path: Path) -> None:
    path, content = tmp_path / "calibration.yaml", content_of(calibrated_sample)
    del content["covariance"]
    path.write_text(yaml.dump(content, Dumper=yaml.CSafeDumper, sort_keys=False))
    with pytest.raises(FileError, match="'covariance' is missing"):
        load_calibration(path)


@pytest.mark.parametrize(
    ("share", "words"),
    [(0, "is empty"), (0.3, "a part of a result.*should follow.*copy"), (0.6, "a part of a result"),
     (0.98, "part of a result|not valid YAML.*ends within a line.*cut off")],
)  # fmt: skip
def test_a_result_that_was_cut_off_is_named(
    share: float, words: str, calibrated_sample: CommandRun, tmp_path: Path
) -> None:
    text = (calibrated_sample.folder / "calibration.yaml").read_text()
    path, lines = tmp_path / "calibration.yaml", text.splitlines(keepends=True)
    whole = "".join(lines[: int(share * len(lines))])
    for cut in (whole, whole[:-1]):
        path.write_text(cut)
        with pytest.raises(FileError, match=words) as caught:
            load_calibration(path)
        assert "\n" not in str(caught.value)


def test_a_rig_that_was_cut_off_is_refused_and_a_whole_one_needs_nothing_else(
    calibrated_sample: CommandRun, tmp_path: Path
) -> None:
    whole, path = load_rig(calibrated_sample.folder), tmp_path / "calibration.yaml"
    lines = (calibrated_sample.folder / "calibration.yaml").read_text().splitlines(keepends=True)
    begin, end = (lines.index(next(a for a in lines if a.startswith(key)))
                  for key in ("rig:", "covariance_of:"))  # fmt: skip
    for count in {begin, begin + 1, *range(begin + 2, end, 7), end}:
        path.write_text("".join(lines[:count]))
        with pytest.raises(FileError, match="part of a result|ends within a line"):
            load_rig(path)
    alone = "".join([lines[0], *lines[begin:end]])
    for text in ("".join(lines[: end + 1]), alone):
        path.write_text(text)
        assert load_rig(path).model_dump_json() == whole.model_dump_json()
        with pytest.raises(FileError, match="part of a result.*'versions' should follow"):
            load_calibration(path)


def test_a_result_that_a_full_disk_cuts_short_leaves_the_older_one(
    calibrated_sample: CommandRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = load_calibration(calibrated_sample.folder)
    write_result(result, tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert {"calibration.yaml", "correspondences.parquet", "report.html"} <= before.keys()

    def fill_up(path: Path, _: str) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr("calibgraph.report.html.write_text", fill_up)
    with pytest.raises(OSError, match="No space") as caught:
        write_result(replace(result, camera_matches=None, warnings=("changed",)), tmp_path)
    assert caught.value.filename == str(tmp_path / "report.html")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_tables_of_the_result_before_do_not_stay_beside_the_new_one(
    calibrated_sample: CommandRun, tmp_path: Path
) -> None:
    result = load_calibration(calibrated_sample.folder)
    write_result(result, tmp_path)
    without = replace(result, correspondences=None, camera_matches=None)
    written = write_result(without, tmp_path, with_report=False)
    assert written[0] == tmp_path / "calibration.yaml"
    assert {*tmp_path.iterdir()} == {*written, tmp_path / "report.html"}


def test_a_result_of_much_metadata_is_replaced_but_no_table_of_others(
    calibrated_sample: CommandRun, tmp_path: Path
) -> None:
    result, path = load_calibration(calibrated_sample.folder), tmp_path / "correspondences.parquet"
    table = result.correspondences
    assert table is not None
    long = table.with_metadata({"of_cameras": "x" * 3 * 2**20})  # 150 kB per camera in practice
    for warning in ("first", "second"):
        replace(result, correspondences=long, warnings=(warning,)).save(tmp_path)
        assert load_calibration(tmp_path).warnings == (warning,)
    long.save(path)
    with pytest.raises(FileError, match="is not the table of"):
        result.save(tmp_path)
    assert load_correspondences(path).metadata == long.metadata


@cache
def read_once(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = yaml.load(path.read_text(), Loader=yaml.CSafeLoader)
    return content


def content_of(result: CommandRun) -> dict[str, Any]:
    """The sample's result, as its file holds it."""
    return deepcopy(read_once(result.folder / "calibration.yaml"))


def edited(change: dict[str, Any], result: CommandRun, folder: Path) -> Path:
    """The sample's result with some keys replaced."""
    path, content = folder / "calibration.yaml", content_of(result) | change
    path.write_text(yaml.dump(content, Dumper=yaml.CSafeDumper, sort_keys=False))
    return path


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [((0, 1), 1.0, "not symmetric"), ((2, 2), -1e-6, "negative variances"),
     ((0, 0), True, "truth value")],
)  # fmt: skip
def test_a_covariance_that_is_none_is_refused(
    place: tuple[int, int], value: Any, words: str, calibrated_sample: CommandRun, tmp_path: Path
) -> None:
    covariance = content_of(calibrated_sample)["covariance"]
    covariance["left"][place[0]][place[1]] = value
    path = edited({"covariance": covariance}, calibrated_sample, tmp_path)
    for read in (load_calibration, stated_result):
        with pytest.raises(FileError, match=f"covariance.left: .*{words}"):
            read(path)


def test_a_verdict_that_was_edited_is_named(calibrated_sample: CommandRun, tmp_path: Path) -> None:
    for key, of in (("camera_verdicts", "of camera 'left'"), ("verdict", "of the rig")):
        part = content_of(calibrated_sample)[key]
        verdict = part if key == "verdict" else part["left"]
        verdict["status"] = {"PASS": "WARN"}.get(verdict["status"], "PASS")
        with pytest.raises(FileError, match=f"{of}, its checks give .* edited"):
            load_calibration(edited({key: part}, calibrated_sample, tmp_path))


def test_whether_an_error_bar_holds_is_true_or_false(
    calibrated_sample: CommandRun, tmp_path: Path
) -> None:
    path = edited({"error_bar_holds": {"left": "yes"}}, calibrated_sample, tmp_path)
    with pytest.raises(FileError, match="error_bar_holds.left"):
        stated_result(path)


def test_unknown_settings_are_refused_and_former_ones_that_changed_nothing_are_not(
    calibrated_sample: CommandRun, tmp_path: Path
) -> None:
    settings = content_of(calibrated_sample)["config"]
    for key, value in (("aggregate", "mean"), ("loss", "huber")):
        file = edited({"config": {**settings, key: value}}, calibrated_sample, tmp_path)
        with pytest.raises(FileError, match=f"unknown key 'config.{key}'"):
            load_calibration(file)
    file = edited({"config": {**settings, "loss": "cauchy"}}, calibrated_sample, tmp_path)
    assert load_calibration(file).config == load_calibration(calibrated_sample.folder).config
