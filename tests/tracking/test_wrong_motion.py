"""Motions that no vehicle has, and frames without one: refused, and where they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibgraph import Config, Correspondences, DurableCalibrator, Rig, concatenate
from calibgraph.errors import MotionError
from calibgraph.simulation.rigs import rig_of
from calibgraph.tracking.command import MOTION_FRAMES, Run
from calibgraph.tracking.history import History
from calibgraph.tracking.streams import Item, Refused, StreamFrame
from factors import Clock
from tests.conftest import Call
from tests.draws.clocks import draw_twists, put_clock_error
from tests.draws.drives import simulate_drive

SWAPPED = [3, 4, 5, 0, 1, 2]
RULE = "twist must be under 6 rad/s, then under 100 m/s (rotation first, in radians), found ["


def drive(twists: np.ndarray, matches: int) -> tuple[Rig, list[Correspondences]]:
    """Frames of a vehicle whose motion is known."""
    rig = rig_of("kitti")
    tables = simulate_drive(lambda _: rig, frames=len(twists), matches=matches)
    return rig, [put_clock_error(table, rig, twists, Clock()) for table in tables]


def swapped_after_two(twists: np.ndarray) -> np.ndarray:
    """Translation first; the vehicle is slow at the beginning."""
    slow = np.where(np.arange(len(twists))[:, None] < 2, 0.1, 1.0)
    return np.asarray((slow * twists)[:, SWAPPED])


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_a_table_of_wrong_motions_is_refused_before_its_first_frame(
    suffix: str, call: Call, tmp_path: Path
) -> None:
    twists = draw_twists(5, np.random.default_rng(1))
    truth, tables = drive(twists, matches=100)
    truth.save(tmp_path / "rig.yaml")
    wrong = swapped_after_two(twists)
    whole = concatenate(tables)
    path = tmp_path / f"table{suffix}"
    spoilt = whole.select(slice(None))
    object.__setattr__(spoilt, "twist_per_s", wrong[whole.frame])  # a table refuses them
    spoilt.save(path)
    code, out, err = call("track", tmp_path / "rig.yaml", path, "--out", tmp_path / "out")
    row = int(np.flatnonzero(whole.frame == 2)[0])
    assert (code, out) == (2, "") and err.count("\n") == 1
    assert f"{path}: row {row} (camera 'image_2', frame 2): {RULE}" in err
    assert err.endswith("; correct the columns wx_rad_s to vz_m_s\n")
    assert not (tmp_path / "out").exists()


def test_one_wrong_motion_in_a_long_stream_is_an_outlier(tmp_path: Path) -> None:
    """A second one before as many sound frames have passed is not."""
    truth, (table,) = drive(draw_twists(1, np.random.default_rng(1)), matches=10)
    wrong = Refused("standard input, line 7: too fast", by_motion=True)

    def sound(first: int, count: int) -> list[Item]:
        numbers = range(first, first + count)
        return [StreamFrame(n, replace(table, frame=np.full_like(table.frame, n))) for n in numbers]

    def follow(items: Sequence[Item]) -> Run:
        with DurableCalibrator(tmp_path / str(len(items)), truth, Config()) as calibrator:
            run = Run(calibrator, History(), lambda _: None, lambda _: None)
            run.follow(items, every=1, stop=lambda: False)
        return run

    once = [*sound(0, MOTION_FRAMES), wrong, *sound(MOTION_FRAMES, 5)]
    run = follow(once)
    assert (run.updates, run.refused) == (MOTION_FRAMES + 5, 1)
    with pytest.raises(MotionError, match=r"line 7: too fast; correct the motion of all frames"):
        follow([*once, wrong])
