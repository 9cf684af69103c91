"""Evidence from images: each hidden cause is found where it is, and nothing where all is right."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import calibgraph
from calibgraph import Correspondences, Dataset, Rig
from calibgraph.trust import image_checks, image_evidence
from calibgraph.trust.image_checks import check_images, evidence_checks, pairing_checks
from calibgraph.trust.image_evidence import ImageEvidence, measure_image_evidence

NAME = "front_left"

NAMES = {n: f"{n:06}" for n in range(6)}
EMPTY = Correspondences.from_arrays(
    camera=NAME,
    frame=np.empty(0, np.int64),
    pixels_px=np.empty((0, 2)),
    points_lidar_m=np.empty((0, 3)),
)


@pytest.fixture
def no_lens(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the fit of the lens, which takes most of the time."""
    monkeypatch.setattr(image_evidence, "measure_lens", lambda *_, **__: ())


def with_clouds_of(dataset: Dataset, order: list[int]) -> Dataset:
    frames = dataset.frames
    swapped = [
        replace(frame, cloud_path=frames[other].cloud_path)
        for frame, other in zip(frames, order, strict=True)
    ]
    return replace(dataset, frames=tuple(swapped))


def statuses(found: ImageEvidence) -> dict[str, str]:
    checks = (*evidence_checks(found, NAMES), *pairing_checks(found))
    return {check.name: check.status for check in checks}


def test_all_checks_pass_at_the_truth(dataset: Dataset, truth: Rig) -> None:
    found = measure_image_evidence(dataset, truth)[NAME]
    assert set(statuses(found).values()) == {"PASS"}
    assert found.frames_best == 1.0
    assert found.frames_lost == ()


@pytest.mark.usefixtures("no_lens")
def test_mispaired_clouds_fail_and_point_to_the_neighbour(dataset: Dataset, truth: Rig) -> None:
    late = measure_image_evidence(with_clouds_of(dataset, [1, 2, 3, 4, 5, 0]), truth)[NAME]
    assert late.pair_offset == -1
    found = statuses(late)
    assert found["score with the own clouds above that with neighbouring ones"] == "FAIL"
    assert found["frames whose score is highest at the result"] == "FAIL"


@pytest.mark.usefixtures("no_lens")
def test_a_single_mispaired_frame_is_named(dataset: Dataset, truth: Rig) -> None:
    found = measure_image_evidence(with_clouds_of(dataset, [0, 1, 2, 5, 4, 5]), truth)[NAME]
    assert found.frames_lost == (3,)


@pytest.mark.usefixtures("no_lens")
def test_mispaired_clouds_are_detected_though_their_neighbours_were_not_selected(
    dataset: Dataset, truth: Rig
) -> None:
    late = with_clouds_of(dataset, [1, 2, 3, 4, 5, 5]).select("0:5:2")
    found = measure_image_evidence(late, truth)[NAME]
    assert found.pair_offset == -1 and found.pair_margin < 0


def test_a_wrong_optimum_fails(dataset: Dataset, truth: Rig) -> None:
    displaced = calibgraph.perturb(truth, rotation_deg=1.2, translation_m=0.1)
    assert "FAIL" in statuses(measure_image_evidence(dataset, displaced)[NAME]).values()


def test_a_camera_without_structure_gets_a_warning(
    dataset: Dataset, truth: Rig, tmp_path: Path
) -> None:
    points = np.random.default_rng(0).uniform(5, 6, (10, 4)).astype(np.float32)
    np.save(tmp_path / "few.npy", points)
    frames = tuple(replace(frame, cloud_path=tmp_path / "few.npy") for frame in dataset.frames)
    checks = check_images(replace(dataset, frames=frames), truth, EMPTY)[NAME]
    assert [check.status for check in checks] == ["WARN"]
    assert "structure in both image and cloud" in checks[0].text


@pytest.mark.parametrize(("displaced_z_score", "status"), [(5.0, "WARN"), (0.1, "PASS")])
def test_clouds_of_another_time_are_shown_by_cameras_that_agree_with_clouds_at_all(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch, displaced_z_score: float, status: str
) -> None:
    """Of a camera that is blurred, or not at its place, the agreement with any cloud is chance."""
    good = ImageEvidence(100, displaced_z_score=5.0, frames_best=1.0, pair_margin=0.5)
    other = replace(good, displaced_z_score=displaced_z_score, pair_offset=-1, pair_margin=-0.6)
    evidence = {"good": good, "other": other}
    monkeypatch.setattr(image_checks, "measure_image_evidence", lambda *_, **__: evidence)
    checks = check_images(dataset, dataset.rig, EMPTY)
    found = {check.name: check.status for check in checks["good"]}
    assert found.get("clouds of another time", "PASS") == status
