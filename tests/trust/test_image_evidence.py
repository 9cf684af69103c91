"""Evidence from images: each hidden cause is found where it is, and nothing where all is right."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import calibgraph
from calibgraph import Camera, Correspondences, Dataset, Rig
from calibgraph.io.dataset import Frame
from calibgraph.model.correspondences import concatenate
from calibgraph.solver.augmented_fit import camera_flow, fit_augmented, moved_by
from calibgraph.trust.image_checks import (
    evidence_checks,
    image_checks,
    offset_checks,
    pairing_checks,
)
from calibgraph.trust.image_evidence import ImageEvidence, lens_columns_px, look_again, with_lens
from calibgraph.trust.time_offset import TimeOffset, image_motion, time_offset
from tests.conftest import KANNALA, RADTAN5, SAMPLE, make_camera

Array = NDArray[np.float64]
NAME = "front_left"


@pytest.fixture(scope="module")
def truth() -> Rig:
    """One camera of the sample at its true pose."""
    whole = calibgraph.load_rig(SAMPLE / "reference.yaml")
    return Rig(cameras={NAME: whole.cameras[NAME]})


@pytest.fixture(scope="module")
def dataset(truth: Rig) -> Dataset:
    return calibgraph.load_dataset(SAMPLE, truth)


@pytest.fixture(scope="module")
def right(dataset: Dataset, truth: Rig) -> ImageEvidence:
    return look_again(dataset, truth)[NAME]


def with_clouds_of(dataset: Dataset, order: list[int]) -> Dataset:
    frames = dataset.frames
    swapped = [
        replace(frame, cloud_path=frames[other].cloud_path)
        for frame, other in zip(frames, order, strict=True)
    ]
    return replace(dataset, frames=tuple(swapped))


def statuses(found: ImageEvidence) -> dict[str, str]:
    checks = (*evidence_checks(found), *pairing_checks(found))
    return {check.name: check.status for check in checks}


def test_nothing_is_found_where_all_is_right(right: ImageEvidence) -> None:
    assert set(statuses(right).values()) == {"PASS"}
    assert right.frames_best == 1.0
    assert right.frames_lost == ()


@pytest.mark.parametrize(
    ("index", "error", "name"),
    [(0, 0.03, "focal length"), (1, -0.1, "radial distortion"), (2, 0.04, "principal point")],
)
def test_wrong_lens_is_named_and_measured(
    dataset: Dataset, truth: Rig, right: ImageEvidence, *, index: int, error: float, name: str
) -> None:
    change = np.zeros(3)
    change[index] = error
    wrong = with_lens(truth.cameras[NAME], change)
    turn = -change[2]  # about the y axis: makes up for the principal point, as a calibration does
    wrong = moved_by(wrong, np.array([0.0, turn, 0.0, 0.0, 0.0, 0.0]))
    found = look_again(dataset, Rig(cameras={NAME: wrong}))[NAME]
    assert found.lens[index] == pytest.approx(-error, abs=0.2 * abs(error) + 0.004)
    # What a calibrated pose would have; the true one of another lens has less.
    found = replace(found, contrast=right.contrast, frames_best=right.frames_best)
    assert statuses(found)[name] != "PASS"
    others = set(statuses(found)) & {"focal length", "radial distortion", "principal point"}
    assert all(statuses(found)[other] == "PASS" for other in others - {name})


def test_mispaired_clouds_are_lost_and_seen_at_the_neighbour(dataset: Dataset, truth: Rig) -> None:
    late = look_again(with_clouds_of(dataset, [1, 2, 3, 4, 5, 0]), truth)[NAME]
    assert late.pair_offset == -1
    found = statuses(late)
    assert found["own clouds' lead over neighbouring ones"] == "FAIL"
    assert found["frames whose image fits the pose best"] == "FAIL"


def test_single_mispaired_frame_is_named(dataset: Dataset, truth: Rig) -> None:
    found = look_again(with_clouds_of(dataset, [0, 1, 2, 5, 4, 5]), truth)[NAME]
    assert found.frames_lost == (3,)


def test_wrong_optimum_is_no_pass(dataset: Dataset, truth: Rig) -> None:
    displaced = calibgraph.perturb(truth, rotation_deg=1.2, translation_m=0.1)
    assert "FAIL" in statuses(look_again(dataset, displaced)[NAME]).values()


def test_camera_without_structure_could_not_be_asked(
    dataset: Dataset, truth: Rig, tmp_path: Path
) -> None:
    points = np.random.default_rng(0).uniform(5, 6, (10, 4)).astype(np.float32)
    np.save(tmp_path / "few.npy", points)
    frames = tuple(replace(frame, cloud_path=tmp_path / "few.npy") for frame in dataset.frames)
    empty = Correspondences.from_arrays(
        camera=NAME,
        frame=np.empty(0, np.int64),
        pixels_px=np.empty((0, 2)),
        points_lidar_m=np.empty((0, 3)),
    )
    checks = image_checks(replace(dataset, frames=frames), truth, empty)[NAME]
    assert [check.status for check in checks] == ["WARN"]
    assert "could not be asked" in checks[0].text


@pytest.mark.parametrize(
    "camera",
    [
        make_camera(),
        make_camera(distortion=RADTAN5),
        make_camera(model="fisheye", distortion=KANNALA),
    ],
)
def test_lens_columns_are_derivatives(camera: Camera) -> None:
    points = scene(np.random.default_rng(0), 200)
    columns = lens_columns_px(camera, points)
    step = 1e-6
    for index in (0, 2):  # the radial column is that of an undistorted pinhole
        change = np.zeros(3)
        change[index] = step
        plus, minus = with_lens(camera, change), with_lens(camera, -change)
        difference = camera_flow(plus, points)[0] - camera_flow(minus, points)[0]
        np.testing.assert_allclose(difference / (2 * step), columns[:, :, index], atol=1e-3)


def scene(rng: np.random.Generator, count: int) -> Array:
    """Points in front of a camera that looks along the LiDAR's x axis."""
    distance = np.exp(rng.uniform(np.log(4), np.log(40), count))
    return distance[:, None] * np.column_stack(
        [np.ones(count), rng.uniform(-0.7, 0.7, count), rng.uniform(-0.2, 0.2, count)]
    )


def seen_late(twists: Array, late: float, noise_px: float) -> tuple[Correspondences, Array]:
    """Correspondences whose pixels are late by so many intervals, and the images' motion."""
    rng = np.random.default_rng(1)
    camera = make_camera()
    tables, motions = [], []
    for frame, twist in enumerate(twists):
        points = scene(rng, 100)
        pixels, flow = camera_flow(camera, points)
        motion = flow @ twist
        tables.append(
            Correspondences.from_arrays(
                camera="front",
                frame=frame,
                pixels_px=pixels + late * motion + noise_px * rng.standard_normal(pixels.shape),
                points_lidar_m=points,
            )
        )
        motions.append(motion)
    return concatenate(tables), np.concatenate(motions)


def turning(frames: int = 20) -> Array:
    """(frames, 6) motion per interval of a vehicle that turns to and fro at a changing speed."""
    phase = np.linspace(0, 2 * np.pi, frames)
    twists = np.zeros((frames, 6))
    twists[:, 1] = 0.02 * np.sin(phase)  # about the camera's y axis, down
    twists[:, 5] = -0.8 + 0.4 * np.cos(phase)
    return twists


def test_time_offset_is_recovered_within_its_sigma() -> None:
    table, motion = seen_late(turning(), late=0.3, noise_px=1.0)
    found = time_offset(make_camera(), table, motion)
    assert found is not None
    assert abs(found.intervals - 0.3) < 3 * found.sigma
    assert found.sigma < 0.1
    assert offset_checks(found)[0].status != "PASS"


def test_even_motion_tells_no_time_offset() -> None:
    even = np.tile([0.0, 0, 0, 0, 0, -0.8], (20, 1)) * (1 + 0.02 * np.sin(np.arange(20)))[:, None]
    table, motion = seen_late(even, late=0.3, noise_px=1.0)
    found = time_offset(make_camera(), table, motion)
    assert found is None or found.sigma > 0.3
    assert all(check.status == "PASS" for check in offset_checks(found))


def test_standing_still_tells_no_time_offset() -> None:
    table, motion = seen_late(np.zeros((20, 6)), late=0.3, noise_px=1.0)
    assert time_offset(make_camera(), table, motion) is None


def test_offset_texts_say_the_direction() -> None:
    (late,) = offset_checks(TimeOffset(intervals=0.5, sigma=0.02, frames=10, motion_px=8.0))
    (early,) = offset_checks(TimeOffset(intervals=-0.2, sigma=0.02, frames=10, motion_px=8.0))
    assert (late.status, early.status) == ("FAIL", "WARN")
    assert "later" in late.text
    assert "earlier" in early.text


def test_image_motion_is_that_of_the_images(tmp_path: Path) -> None:
    camera = make_camera()
    rng = np.random.default_rng(2)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (376, 1300)).astype(np.float32), (0, 0), 2.0)
    texture = cv2.normalize(texture, texture, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    frames = []
    for index in range(3):  # the picture moves 4 px to the right from image to image
        path = tmp_path / f"{index}.png"
        cv2.imwrite(str(path), texture[:, 30 - 4 * index :][:, :1240])
        frames.append(Frame(index, str(index), tmp_path / f"{index}.npy", {"front": path}))
    data = Dataset(Rig(cameras={"front": camera}), tuple(frames), (tmp_path,))
    pixels = rng.uniform([100, 50], [1100, 300], (30, 2))
    table = Correspondences.from_arrays(
        camera="front", frame=1, pixels_px=pixels, points_lidar_m=np.ones((30, 3))
    )
    motion = image_motion(data, "front", camera, table)
    np.testing.assert_allclose(motion, np.tile([4.0, 0.0], (30, 1)), atol=0.1)
    alone = image_motion(data.select("1"), "front", camera, table)  # neighbours were recorded
    np.testing.assert_array_equal(alone, motion)


def test_mispaired_clouds_are_seen_though_their_neighbours_were_not_selected(
    dataset: Dataset, truth: Rig
) -> None:
    late = with_clouds_of(dataset, [1, 2, 3, 4, 5, 5]).select("0:5:2")
    found = look_again(late, truth)["front_left"]
    assert found.pair_offset == -1 and found.pair_margin < 0


def test_augmented_fit_is_exact_without_noise() -> None:
    rng = np.random.default_rng(3)
    camera, points = make_camera(), scene(rng, 300)
    column = rng.standard_normal((300, 2, 1))
    twist = 1e-4 * rng.standard_normal(6)
    pixels, flow = camera_flow(camera, points)
    table = Correspondences.from_arrays(
        camera="front",
        frame=np.arange(300) % 5,
        pixels_px=pixels + flow @ twist + 0.7 * column[:, :, 0],
        points_lidar_m=points,
    )
    fit = fit_augmented(camera, table, column)
    assert fit is not None
    np.testing.assert_allclose(fit.values, [0.7], rtol=1e-9)
    np.testing.assert_allclose(fit.twist, twist, atol=1e-12)
    seen = camera_flow(moved_by(camera, fit.twist), points)[0]
    np.testing.assert_allclose(seen, pixels + flow @ twist, atol=1e-3)  # second order: 1e-7 f


def test_unknown_that_a_pose_imitates_is_refused() -> None:
    points = scene(np.random.default_rng(4), 100)
    pixels, flow = camera_flow(make_camera(), points)
    table = Correspondences.from_arrays(
        camera="front", frame=0, pixels_px=pixels, points_lidar_m=points
    )
    assert fit_augmented(make_camera(), table, flow[:, :, :1]) is None
