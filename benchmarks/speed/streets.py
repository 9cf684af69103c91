"""Rendered streets to calibrate on: any number of cameras and frames, any image size."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from benchmarks.speed.solvers import ring
from calibgraph import Camera, Intrinsics, Rig, load_rig, perturb, simulate_street

RING = 12
"""Cameras around the LiDAR; fewer are the first of them, from the one ahead to the left."""
DRAWN_FRAMES = 5
"""More frames repeat them, with the points of the clouds in another order: copies are left out."""
FOCAL_SHARE = 0.58  # of the width: as KITTI's cameras, 82 degrees
ROTATION_DEG, TRANSLATION_M = 2.0, 0.2  # of the guess


def street_rig(cameras: int, width_px: int, height_px: int) -> Rig:
    """The first cameras of the ring, with images of a size."""
    f = FOCAL_SHARE * width_px
    centre = 0.5 * (width_px - 1), 0.5 * (height_px - 1)
    lens = Intrinsics(fx=f, fy=f, cx=centre[0], cy=centre[1])

    def resized(camera: Camera) -> Camera:
        return Camera(
            width_px=width_px,
            height_px=height_px,
            intrinsics_px=lens,
            T_camera_lidar=camera.T_camera_lidar,
        )

    first = list(ring(RING).cameras.items())[:cameras]
    return Rig(cameras={name: resized(camera) for name, camera in first})


def render(folder: Path, rig: Rig) -> Path:
    """Render a drive with a rig, unless it is there already.

    Args:
        folder: of all drives.
        rig: its extrinsics are the truth.

    Returns:
        Its folder.
    """
    camera = next(iter(rig.cameras.values()))
    drive = folder / f"rendered_{camera.width_px}x{camera.height_px}_{len(rig.cameras)}"
    if not (drive / "rig.yaml").is_file():
        simulate_street(drive, rig, frames=DRAWN_FRAMES)
    return drive


def link_dataset(rendered: Path, folder: Path, cameras: int, frames: int) -> None:
    """Make a dataset of a rendered drive's first cameras, its frames repeated as often as needed.

    Args:
        rendered: of :func:`render`.
        folder: to make, on the same file system.
        cameras: how many of its cameras.
        frames: how many frames.
    """
    truth = load_rig(rendered / "reference.yaml")
    names = list(truth.cameras)[:cameras]
    rig = Rig(cameras={name: truth.cameras[name] for name in names})
    guess = perturb(rig, rotation_deg=ROTATION_DEG, translation_m=TRANSLATION_M, seed=0)
    for part in ("lidar", *(f"cameras/{name}" for name in names)):
        files = sorted((rendered / part).iterdir())
        (folder / part).mkdir(parents=True)
        for frame in range(frames):
            file = files[frame % len(files)]
            linked = folder / part / f"{frame:06d}{file.suffix}"
            if part == "lidar" and frame >= len(files):
                np.save(linked, np.roll(np.load(file), frame, axis=0))
            else:
                os.link(file, linked)
    guess.save(folder / "rig.yaml")
