"""An epoch as a few arrays: every frame comes back as it was."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from calibgraph.solver.camera_block import CameraBlock
from calibgraph.tracking.epoch_arrays import from_arrays, to_arrays
from calibgraph.tracking.live_frames import Epoch, LiveFrame
from calibgraph.tracking.sums import Sums
from factors import Lens, ProjectionBlock

LENS = Lens.pinhole(fx=700.0, fy=710.0, cx=320.0, cy=240.0)
OPTIONAL = ("sqrt_information", "motion")


def frame_of(number: int, counts: dict[int, int], *, columns: bool) -> LiveFrame:
    """A frame of two cameras, with all optional columns or none."""
    rng = np.random.default_rng(number)
    raw, inliers = {}, {}
    for camera, count in counts.items():
        root, motion, information = (
            rng.uniform(0.5, 2.0, (count, width)) if columns else None for width in (3, 7, 3)
        )
        points, pixels = rng.uniform(1, 9, (count, 3)), rng.uniform(0, 400, (count, 2))
        block = ProjectionBlock(LENS, points, pixels, root, motion=motion)
        raw[camera] = CameraBlock(block, information, np.full(count, number, np.int64))
        inliers[camera] = rng.uniform(size=count) < 0.7
    sums = Sums(rng.uniform(size=Sums.zeros(2).packed.shape))
    return LiveFrame(number, raw, inliers, sums, f"place {number}", rng.uniform(size=(2, 6)))


@pytest.mark.parametrize("columns", [(False, False), (True, True), (True, False), (False, True)])
def test_frames_of_an_epoch_come_back_to_the_last_bit(columns: tuple[bool, bool]) -> None:
    """Also a camera without matches in a frame, and columns that one frame alone has."""
    poses = gtsam.Pose3(), gtsam.Pose3(gtsam.Rot3(), np.ones(3))
    frames = (
        frame_of(3, {0: 7, 1: 9}, columns=columns[0]),
        frame_of(5, {1: 6}, columns=columns[1]),
        frame_of(8, {}, columns=False),
    )
    epoch = Epoch.empty(poses)
    held = from_arrays(to_arrays(Epoch(frames, poses, epoch.distortion)))
    assert held.T_lidar_camera == poses and held.width == 6
    for one, back in zip(frames, held.frames, strict=True):
        assert (back.number, back.place) == (one.number, one.place)
        np.testing.assert_array_equal(back.sums.packed, one.sums.packed)
        np.testing.assert_array_equal(back.twists_per_s, one.twists_per_s)
        assert [*back.raw] == [*one.raw] == [*back.inliers]
        for camera, block in one.raw.items():
            found = back.raw[camera]
            np.testing.assert_array_equal(back.inliers[camera], one.inliers[camera])
            np.testing.assert_array_equal(found.frame, block.frame)
            np.testing.assert_array_equal(found.block.points_lidar_m, block.block.points_lidar_m)
            np.testing.assert_array_equal(found.block.pixels_px, block.block.pixels_px)
            pairs = [(found.information, block.information)]
            pairs += [(getattr(found.block, n), getattr(block.block, n)) for n in OPTIONAL]
            for held_column, column in pairs:
                assert (held_column is None) == (column is None)
                if column is not None:
                    np.testing.assert_array_equal(held_column, column)


def test_an_epoch_without_frames_comes_back() -> None:
    poses = (gtsam.Pose3(),)
    held = from_arrays(to_arrays(Epoch.empty(poses)))
    assert held.frames == () and held.T_lidar_camera == poses
