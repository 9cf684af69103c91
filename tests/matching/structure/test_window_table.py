from __future__ import annotations

import numpy as np
import pytest

import calibgraph
from calibgraph import Rig
from calibgraph.matching.structure import window_table
from calibgraph.matching.structure.prepared_cloud import PreparedCloud
from calibgraph.matching.structure.schedule import LEVELS
from calibgraph.matching.structure.shift_scores import score_frame, select_windows
from calibgraph.matching.structure.window_table import WindowTable
from tests.conftest import SAMPLE


@pytest.fixture
def cloud() -> PreparedCloud:
    return PreparedCloud.from_points(calibgraph.load_dataset(SAMPLE).frames[0].load_cloud())


def centres(windows: object) -> set[tuple[float, ...]]:
    return {tuple(ray) for ray in windows.rays_m[:, 0].tolist()}  # type: ignore[attr-defined]


def test_a_small_motion_of_the_camera_keeps_most_windows(cloud: PreparedCloud, truth: Rig) -> None:
    camera = truth.cameras["front_left"]
    T = camera.T_camera_lidar.copy()
    T[0, 3] += 0.02
    one, two = (
        centres(select_windows(cloud, each, LEVELS[3], max_windows=2_000))
        for each in (camera, camera.moved_to(T))
    )
    assert len(one & two) > 0.9 * max(len(one), len(two)) > 100


def test_a_table_that_was_dropped_is_made_again_alike(
    cloud: PreparedCloud, truth: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera, level = truth.cameras["front_left"], LEVELS[2]
    first = score_frame(
        calibgraph.load_dataset(SAMPLE).frames[0].load_gray("front_left", camera),
        cloud, camera, level, frame=0, max_windows=1_000,
    )  # fmt: skip
    made: list[int] = []
    original = WindowTable.__init__

    def counted(table: WindowTable, *arguments: object, **options: object) -> None:
        made.append(1)
        original(table, *arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(window_table, "MAX_BYTES", 0)
    monkeypatch.setattr(WindowTable, "__init__", counted)
    select_windows(cloud, camera, LEVELS[3], max_windows=1_000)  # in place of the other
    again = score_frame(
        calibgraph.load_dataset(SAMPLE).frames[0].load_gray("front_left", camera),
        cloud, camera, level, frame=0, max_windows=1_000,
    )  # fmt: skip
    assert len(made) == 2
    np.testing.assert_array_equal(first.grids, again.grids)
