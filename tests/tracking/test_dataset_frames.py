"""Frames of a dataset, matched while tracking, and those whose images are scored at the end."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import pytest

from calibgraph import (
    Calibration,
    Config,
    Correspondences,
    DatasetError,
    IncrementalCalibrator,
    Rig,
    concatenate,
)
from calibgraph.arrays import Array
from calibgraph.io.dataset import Dataset, load_dataset
from calibgraph.model.config import Tracking as Settings
from calibgraph.tracking import command, dataset_frames
from calibgraph.tracking.command import Tracking, track
from calibgraph.trust import evidence
from calibgraph.trust.pose_posterior import PosePosterior, no_posteriors
from tests.conftest import stereo_relative_pose
from tests.tracking.drives import FRAMES, Crashed, World, drive, flat, pair_of

pytestmark = pytest.mark.usefixtures("no_picture")


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
        wanted = Tracking(rig=recorded.rig, config=Config(), out=out, matcher=matcher)
        try:
            track(wanted, recorded.folders, notify=messages.append)
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


def test_flat_images_widen_the_result_at_the_end_and_its_verdict(
    world: World, recorded: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The lines stay as they are: images are scored once, at the end, on the kept frames."""
    asked: list[tuple[Dataset, Rig]] = []

    def measure(data: Dataset, rig: Rig, known: object, groups: object, *, seed: int) -> object:
        asked.append((data, rig))
        return {"left": flat(np.radians(1.0), 0.25)}

    def run(name: str, matcher: Given) -> Calibration:
        wanted = Tracking(rig=recorded.rig, config=Config(), out=tmp_path / name, matcher=matcher)
        return track(wanted, recorded.folders, notify=lambda _: None)[0]

    monkeypatch.setattr(evidence, "measure_posteriors", no_posteriors)
    monkeypatch.setattr(dataset_frames, "measure_posteriors", measure)
    monkeypatch.setattr(Given, "image_checks_can_fail", True, raising=False)
    wide = run("wide", Given(concatenate(world.tables)))
    ((data, rig),) = asked
    assert [frame.index for frame in data.frames] == [*range(FRAMES)]
    monkeypatch.setattr(Given, "image_checks_can_fail", False, raising=False)
    narrow = run("narrow", Given(concatenate(world.tables)))
    assert len(asked) == 1
    for name, T in narrow.T_camera_lidar.items():
        np.testing.assert_array_equal(wide.T_camera_lidar[name], T)
        np.testing.assert_array_equal(rig.T_camera_lidar[name], T)
    wider = {n: wide.sigmas(n)[1] / narrow.sigmas(n)[1] for n in ("left", "right")}
    assert wider["left"].min() > 3 and wider["right"].max() == pytest.approx(1)
    np.testing.assert_array_equal(wide.joint_covariance[:6, :6], wide.covariance["left"])
    kinds = {check.kind: check for check in wide.camera_verdicts["left"].checks}
    beyond = kinds["beyond_tolerance"]
    assert beyond.status == "WARN" and beyond.value is not None and beyond.value > 0.5
    assert wide.camera_verdicts["left"].status == "WARN"
    assert wide.camera_verdicts["left"].cannot_tell
    assert "beyond_tolerance" not in {c.kind for c in narrow.camera_verdicts["left"].checks}
    assert "images" in narrow.verdict.images_note and not wide.verdict.images_note


SHORT = Config(tracking=Settings(epoch_frames=4, live_epochs=2))
"""Of 14 frames the last ten are live, of 22 the last 10."""


def rig_of(*, tied: bool) -> Rig:
    rig = pair_of()
    known = stereo_relative_pose(rig, sigmas=(1e-3, 1e-2))
    return rig.model_copy(update={"relative_poses": (known,) if tied else ()})


class Scorer:
    """Notes which groups are asked for, by frames."""

    def __init__(self) -> None:
        self.asked: dict[tuple[int, ...], list[tuple[str, ...]]] = {}

    def __call__(
        self, numbers: Sequence[int], known: Mapping[str, Array], groups: Sequence[Sequence[str]]
    ) -> dict[str, PosePosterior]:
        self.asked[tuple(numbers)] = [tuple(group) for group in groups]
        return {name: flat(0.02, 0.3) for group in groups for name in group}


def result_of(scorer: Scorer, frames: int, *, tied: bool, **blind: Any) -> Calibration:
    rig = rig_of(tied=tied)
    tracker = IncrementalCalibrator(rig, SHORT)
    for number, table in enumerate(drive(rig, frames, blind=blind)):
        tracker.update(table, frame=number)
    return tracker.calibration(scorer)


LEFT, RIGHT, BOTH = ("left",), ("right",), ("left", "right")


@pytest.mark.parametrize(
    ("tied", "blind", "asked"),
    [
        (True, {}, {range(4, 14): [BOTH]}),
        (False, {}, {range(4, 14): [LEFT, RIGHT]}),
        (True, {"right": [7]}, {(4, 5, 6, *range(8, 14)): [BOTH]}),
        (False, {"right": [7]}, {range(4, 14): [LEFT], (4, 5, 6, *range(8, 14)): [RIGHT]}),
        *(
            (
                tied,
                {"left": range(1, 14, 2), "right": range(0, 14, 2)},
                {range(4, 14, 2): [LEFT], range(5, 14, 2): [RIGHT]},
            )
            for tied in (True, False)
        ),
        *(
            (tied, {"right": range(6, 14)}, {range(4, 14): [LEFT], (4, 5): [RIGHT]})
            for tied in (True, False)
        ),
    ],
)
def test_cameras_are_scored_on_frames_that_show_them(
    tied: bool, blind: Any, asked: dict[Sequence[int], list[tuple[str, ...]]]
) -> None:
    """Tied ones on common frames, if there are enough."""
    scorer = Scorer()
    result = result_of(scorer, 14, tied=tied, **blind)
    assert scorer.asked == {tuple(frames): groups for frames, groups in asked.items()}
    for verdict in result.camera_verdicts.values():
        assert "flat_evidence" in {check.kind for check in verdict.checks}
