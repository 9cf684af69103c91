"""What is deployed on rendered streets: the alignment, not the mount."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.accuracy import audit
from benchmarks.accuracy.audit import STREETS
from benchmarks.accuracy.scenes import Folders
from tools.scenes.sensor_streets import ALIGNMENT, RIGS


def test_cameras_of_a_scene_are_at_the_mean_alignment_of_its_streets(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mounts = RIGS[0][1]()
    name, T = next(iter(mounts.T_camera_lidar.items()))
    for street in range(STREETS):
        folder = tmp_path / "scene_0" / f"street_{street}"
        folder.mkdir(parents=True)
        mounts.save(folder / "reference.yaml")
        moved = np.eye(4)
        moved[1, 3] = 0.01 * (street + 1)  # 1, 2 and 3 cm
        mounts.moved_to({**mounts.T_camera_lidar, name: moved @ T}).save(folder / ALIGNMENT)
    monkeypatch.setattr(audit, "load_dataset", list)

    streets, rig = audit.load("scene_0", Folders(tmp_path, tmp_path))

    assert len(streets) == STREETS
    assert (rig.T_camera_lidar[name] - T)[:, 3] == pytest.approx([0, 0.02, 0, 0])
