"""Windows of left-out rigs: who takes part in what, and what a table's cells say."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from benchmarks.accuracy import left_out_windows  # noqa: E402
from benchmarks.accuracy.left_out_windows import (  # noqa: E402
    ALIKE,
    OWN,
    PACKAGE,
    cells,
    rigs,
    weights_for,
)
from benchmarks.accuracy.window_weights import REACH, RECORDINGS, Sample  # noqa: E402

SIDE = 2 * REACH + 1


def sample(peak: tuple[int, int], count: int = 6) -> Sample:
    scores = torch.zeros((count, SIDE, SIDE))
    scores[:, REACH + peak[0], REACH + peak[1]] = 2.0
    return Sample(np.ones((count, 2), dtype=np.float32), scores)


def test_no_recording_of_a_rig_trains_the_weights_that_judge_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    recorded = {name: sample((0, 0)) for name in (*RECORDINGS, OWN)}
    names = {id(each): name for name, each in recorded.items()}
    seen: list[set[str]] = []

    class Network:
        def weights(self, features: np.ndarray) -> np.ndarray:
            return np.full(len(features), 0.5, dtype=np.float32)

    def train(samples: list[Sample], seed: int) -> Network:
        seen.append({names[id(each)] for each in samples if id(each) in names})
        return Network()

    monkeypatch.setattr(left_out_windows, "train", train)
    for rig, own in rigs().items():
        known = {frozenset({kind}): Network().weights for kind in (ALIKE, PACKAGE)}
        seen.clear()
        kinds = list(weights_for(rig, [sample((0, 0))], recorded, known, seed=0))
        assert len(kinds) == 6
        assert {OWN} in seen and all(used.isdisjoint(own) for used in seen)
    assert {name for names in rigs().values() for name in names} == {*RECORDINGS}
    assert {"00", "kitti_places", "kitti_raw_0005"} <= {*rigs()["kitti"]}


def test_cells_tell_windows_that_are_right_from_windows_that_are_not() -> None:
    kinds = [(lambda features: np.full(len(features), 0.5, dtype=np.float32), 5.0)]
    nats, share, z = map(float, cells(sample((1, -1)), kinds))
    assert nats < -0.9 and share == 1 and z > 1
    nats, share, z = map(float, cells(sample((5, 0)), kinds))
    assert nats > 0 and share == 0 and z < 0
