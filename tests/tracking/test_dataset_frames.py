"""Frames of a dataset, matched while tracking."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest

from calibgraph import Config, Correspondences, DatasetError, Rig, concatenate
from calibgraph.io.dataset import Dataset, load_dataset
from calibgraph.tracking import command
from calibgraph.tracking.command import open_drive, track
from tests.tracking.drives import FRAMES, Crashed, World

pytestmark = pytest.mark.usefixtures("not_warmed_up")


@dataclass
class Given:
    """A matcher that finds a table's rows, worse ones in its first round."""

    table: Correspondences
    unreadable: tuple[int, ...] = ()
    rounds: int = 2
    stage1: Literal["pnp", "rig"] = "pnp"

    def match(
        self, dataset: Dataset, rig: Rig, *, round_index: int, progress: object
    ) -> Correspondences:
        frames = [frame.index for frame in dataset.frames]
        for number in frames:
            if number in self.unreadable:
                raise DatasetError(f"image {number} is truncated", frame=number)
        # What it finds depends on where it starts from, as with any matcher.
        shift = 10.0 * rig.T_camera_lidar["left"][0, 3]
        found = self.table.select(np.isin(self.table.frame, frames))
        return replace(found, pixels_px=found.pixels_px + 0.01 * shift + 0.1 * (1 - round_index))


@pytest.fixture
def recorded(world: World, tmp_path: Path) -> Dataset:
    folder = tmp_path / "data"
    for place in ("cameras/left", "cameras/right", "lidar"):
        (folder / place).mkdir(parents=True)
        for number in range(FRAMES):
            if place == "lidar":
                np.save(
                    folder / place / f"{number:03d}.npy", np.full((9, 4), 1 + number, np.float32)
                )
                continue
            camera = world.guess.cameras[place.removeprefix("cameras/")]
            image = np.full((camera.height_px, camera.width_px), number, np.uint8)
            cv2.imwrite(str(folder / place / f"{number:03d}.png"), image)
    shutil.copy(world.rig, folder / "rig.yaml")
    return load_dataset(folder)


@pytest.mark.parametrize("at", [pytest.param(0, marks=pytest.mark.slow), 3, 8])
def test_a_dataset_continues_after_a_crash_and_around_an_unreadable_frame(
    at: int,
    world: World,
    recorded: Dataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A crash among the first frames, which are matched as a batch, or after them."""
    matcher = Given(concatenate(world.tables), unreadable=(7,))

    def lines(out: Path, crash: int | None) -> tuple[list[str], list[str]]:
        given: list[str] = []
        messages: list[str] = []

        def write(line: str) -> None:
            if len(given) == crash:
                raise Crashed
            given.append(line)

        monkeypatch.setattr(command, "print_line", write)
        drive = open_drive(recorded.folders, recorded.rig, Config(), matcher=matcher)
        wanted = {"config": Config(), "out": out, "drive": drive}
        try:
            track(recorded.rig, recorded.folders, notify=messages.append, **wanted)
        except Crashed:
            assert crash is not None
        return given, messages

    whole, messages = lines(tmp_path / "whole", None)
    assert [json.loads(line)["frame"] for line in whole] == [f for f in range(FRAMES) if f != 7]
    assert [s for s in messages if s.startswith("left out")] == [
        "left out: frame 007 (7): image 7 is truncated"
    ]
    first, _ = lines(tmp_path / "crashed", at)
    second, _ = lines(tmp_path / "crashed", None)
    assert first + second == whole
