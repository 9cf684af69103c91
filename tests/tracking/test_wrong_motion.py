"""Motions that no vehicle has, and frames without one: refused, and where they are."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibgraph import Correspondences, DurableCalibrator, concatenate
from calibgraph.errors import MotionError
from calibgraph.tracking.history import History
from calibgraph.tracking.run import MOTION_FRAMES, Run
from calibgraph.tracking.streams import Item, Refused, StreamFrame
from tests.conftest import Call
from tests.tracking.drives import content_of
from tests.tracking.late_drives import OFFSET, late, town

SWAPPED = [3, 4, 5, 0, 1, 2]
RULE = "twist must be under 6 rad/s, then under 100 m/s (rotation first, in radians), found ["


def with_twists(tables: Sequence[Correspondences], by: Callable[[Any], Any]) -> bytes:
    """As lines of JSON, with other motions."""
    content = [
        {**content_of(table), "twist_per_s": by(table.twist_per_s[0]).tolist()}
        for table in tables
        if table.twist_per_s is not None
    ]
    return b"".join(json.dumps(one).encode() + b"\n" for one in content)


def swapped_after_two(twists: np.ndarray) -> np.ndarray:
    """Translation first; the vehicle is slow at the beginning."""
    slow = np.where(np.arange(len(twists))[:, None] < 2, 0.1, 1.0)
    return np.asarray((slow * twists)[:, SWAPPED])


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
@pytest.mark.parametrize("in_folder", [False, True])
def test_a_table_of_wrong_motions_is_refused_before_its_first_frame(
    suffix: str, in_folder: bool, call: Call, tmp_path: Path
) -> None:
    twists = town(5, 1)
    truth, tables = late(twists, np.zeros(5))
    truth.save(tmp_path / "rig.yaml")
    wrong = swapped_after_two(twists)
    whole = concatenate(tables)
    path = tmp_path / "tables" / f"table{suffix}"
    path.parent.mkdir()
    spoilt = whole.select(slice(None))
    object.__setattr__(spoilt, "twist_per_s", wrong[whole.frame])  # a table refuses them
    spoilt.save(path)
    source = path.parent if in_folder else path
    code, out, err = call(
        "track", tmp_path / "rig.yaml", source, "--estimate", "offset", "--out", tmp_path / "out"
    )
    row = int(np.flatnonzero(whole.frame == 2)[0])
    assert (code, out) == (2, "") and err.count("\n") == 1
    assert f"{path}: row {row} (camera 'image_2', frame 2): {RULE}" in err
    assert err.endswith("; correct the columns wx_rad_s to vz_m_s\n")
    assert not (tmp_path / "out").exists()


def test_a_stream_of_wrong_motions_ends_at_its_line(
    piped: Callable[..., Any], tmp_path: Path
) -> None:
    truth, tables = late(town(5, 1), np.zeros(5))
    truth.save(tmp_path / "rig.yaml")
    given = with_twists(tables[:1], lambda t: 0.1 * t) + with_twists(
        tables[1:], lambda t: t[SWAPPED]
    )
    code, _, err = piped(
        tmp_path / "rig.yaml", given, "--estimate", "offset", "--out", tmp_path / "out"
    )
    assert code == 2
    assert f"standard input, line 2: row 0 (camera 'image_2', frame 1): {RULE}" in err
    assert err.endswith("correct the motion of all frames, and take another --out\n")
    assert not (tmp_path / "out" / "calibration.yaml").exists()


def test_one_wrong_motion_in_a_long_stream_is_an_outlier(tmp_path: Path) -> None:
    """A second one before as many sound frames have passed is not."""
    truth, (table,) = late(town(1, 1), np.zeros(1), matches=10)
    wrong = Refused("standard input, line 7: too fast", by_motion=True)

    def sound(first: int, count: int) -> list[Item]:
        numbers = range(first, first + count)
        return [StreamFrame(n, replace(table, frame=np.full_like(table.frame, n))) for n in numbers]

    def follow(items: Sequence[Item]) -> Run:
        with DurableCalibrator(tmp_path / str(len(items)), truth, OFFSET) as calibrator:
            run = Run(calibrator, History(), lambda _: None, lambda _: None)
            run.follow(items, every=1, stop=lambda: False)
        return run

    once = [*sound(0, MOTION_FRAMES), wrong, *sound(MOTION_FRAMES, 5)]
    run = follow(once)
    assert (run.updates, run.refused) == (MOTION_FRAMES + 5, 1)
    with pytest.raises(MotionError, match=r"line 7: too fast; correct the motion of all frames"):
        follow([*once, wrong])


def test_a_frame_without_its_motion_is_left_out_by_its_line(
    piped: Callable[..., Any], tmp_path: Path
) -> None:
    truth, tables = late(town(3, 1), np.zeros(3))
    truth.save(tmp_path / "rig.yaml")
    without = json.dumps(content_of(tables[1])).encode() + b"\n"
    given = with_twists(tables[:1], np.asarray) + without + with_twists(tables[2:], np.asarray)
    _, out, err = piped(
        tmp_path / "rig.yaml", given, "--estimate", "offset", "--out", tmp_path / "out"
    )
    assert len(out.splitlines()) == 2
    assert "left out: standard input, line 2: to estimate offset, the motion of the LiDAR" in err


@pytest.mark.parametrize("name", ["images", "drive.mcap"])
def test_a_dataset_without_a_matcher_is_told_from_tables(
    name: str, call: Call, tmp_path: Path
) -> None:
    truth, _ = late(town(1, 1), np.zeros(1))
    truth.save(tmp_path / "rig.yaml")
    if "." in name:
        (tmp_path / name).write_bytes(b"\x89MCAP0\r\n")
    else:
        (tmp_path / name / "image_2").mkdir(parents=True)
    code, _, err = call("track", tmp_path / "rig.yaml", tmp_path / name, "--out", tmp_path / "out")
    assert code == 2 and err.count("\n") == 1
    assert "to track a dataset, say what matches its frames: --matcher structure" in err
