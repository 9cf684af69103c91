from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph import Correspondences, Dataset, Rig
from calibgraph.io.frame import Frame
from calibgraph.model.correspondences import concatenate
from calibgraph.solver.camera_twist import project_with_jacobian
from calibgraph.trust.image_checks import offset_checks
from calibgraph.trust.time_offset import TimeOffset, image_motion, time_offset
from tests.conftest import make_camera, points_in_front

Array = NDArray[np.float64]


def seen_late(twists: Array, late: float, noise_px: float) -> tuple[Correspondences, Array]:
    """Correspondences whose pixels are late by so many intervals, and the images' motion."""
    rng = np.random.default_rng(1)
    camera = make_camera()
    tables, motions = [], []
    for frame, twist in enumerate(twists):
        points = points_in_front(rng, 100)
        pixels, jacobian = project_with_jacobian(camera, points)
        motion = jacobian @ twist
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


def turning_drive(frames: int = 20) -> Array:
    """(frames, 6) motion per interval of a vehicle that turns both ways at a changing speed."""
    phase = np.linspace(0, 2 * np.pi, frames)
    twists = np.zeros((frames, 6))
    twists[:, 1] = 0.02 * np.sin(phase)  # about the camera's y axis, down
    twists[:, 5] = -0.8 + 0.4 * np.cos(phase)
    return twists


def test_time_offset_is_recovered_within_its_sigma() -> None:
    table, motion = seen_late(turning_drive(), late=0.3, noise_px=1.0)
    found = time_offset(make_camera(), table, motion)
    assert found is not None
    assert abs(found.intervals - 0.3) < 3 * found.sigma
    assert found.sigma < 0.1
    assert offset_checks(found)[0].status != "PASS"


def test_uniform_motion_does_not_determine_the_time_offset() -> None:
    uniform = (
        np.tile([0.0, 0, 0, 0, 0, -0.8], (20, 1)) * (1 + 0.02 * np.sin(np.arange(20)))[:, None]
    )
    table, motion = seen_late(uniform, late=0.3, noise_px=1.0)
    found = time_offset(make_camera(), table, motion)
    assert found is None or found.sigma > 0.3
    assert all(check.status == "PASS" for check in offset_checks(found))


def test_a_standing_vehicle_has_no_time_offset() -> None:
    table, motion = seen_late(np.zeros((20, 6)), late=0.3, noise_px=1.0)
    assert time_offset(make_camera(), table, motion) is None


def test_texts_name_the_direction_of_the_offset() -> None:
    (late,) = offset_checks(TimeOffset(intervals=0.5, sigma=0.02, frames=10, motion_px=8.0))
    (early,) = offset_checks(TimeOffset(intervals=-0.2, sigma=0.02, frames=10, motion_px=8.0))
    assert (late.status, early.status) == ("FAIL", "WARN")
    assert "later" in late.text
    assert "earlier" in early.text


def test_image_motion_is_measured_between_neighbouring_images(tmp_path: Path) -> None:
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
