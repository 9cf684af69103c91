"""Rendered drives of a camera whose lens and clock are wrong: rows are taken in turn, and late."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph import Dataset, Rig, dataset_from_arrays
from calibgraph.model.geometry import relative_transform
from calibgraph.simulation.cameras import CameraRays, camera_rays, develop, trace_light
from calibgraph.simulation.lidar import lidar_of, ring_gains, scan
from calibgraph.simulation.recording import build_drive
from calibgraph.simulation.rigs import rig_of
from calibgraph.simulation.world import World
from factors import Clock
from tests.draws.clocks import draw_twists
from tools.scenes.scan_errors import ScanErrors

FRAMES, STEP_M, STRIP_PX = 5, 15.0, 16
ERRORS = ScanErrors(beam_mrad=2.0, dark_m=0.02)
WRONG = (
    ("offset",), ("focal",), ("readout",), ("centre",), ("offset", "readout"), ("distortion",),
    ("offset", "focal"), ("focal", "centre", "distortion"),
)  # fmt: skip
"""What is wrong, by the number of the rig."""
RANGES = {
    "focal": (0.003, 0.05), "centre": (3.0, 30.0), "distortion": (0.01, 0.1),
    "offset": (0.005, 0.1), "readout": (0.003, 0.03),
}  # fmt: skip

Array = NDArray[np.float64]


def draw_wrong(seed: int) -> dict[str, float]:
    """What is wrong by how much."""
    rng = np.random.default_rng([seed, 5])
    sizes = {name: float(np.exp(rng.uniform(*np.log(RANGES[name])))) for name in RANGES}
    signs = {name: 1.0 if name == "readout" else float(rng.choice([-1, 1])) for name in RANGES}
    return {name: signs[name] * sizes[name] for name in WRONG[seed % len(WRONG)]}


def truth_of(seed: int) -> Rig:
    """A camera like KITTI's, and when it takes its images."""
    rig, wrong = rig_of("kitti"), draw_wrong(seed)
    name, camera = next(iter(rig.cameras.items()))
    times = {"time_offset_s": wrong.get("offset", 0.0), "readout_s": wrong.get("readout", 0.0)}
    return Rig(cameras={name: camera.model_copy(update=times)})


def load_drive(folder: Path, seed: int) -> Dataset:
    """The drive of a rig; rendered if it is not there."""
    path, truth = folder / f"{seed}.npz", truth_of(seed)
    if not path.is_file():
        np.savez(path, **render_drive(truth, seed))
    with np.load(path) as kept:
        clouds = [kept[f"cloud_{n}"] for n in range(FRAMES)]
        images = {name: [*kept["images"]] for name in truth.cameras}
        return dataset_from_arrays(truth, clouds, images, twists_per_s=kept["twists"])


def render_drive(truth: Rig, seed: int) -> dict[str, NDArray[Any]]:
    """Clouds, images and twists of a drive."""
    drive = build_drive(frames=FRAMES, step_m=STEP_M, seed=seed, vary_layout=True)
    lidar, camera = replace(lidar_of(64), errors=ERRORS), next(iter(truth.cameras.values()))
    twists = draw_twists(FRAMES, np.random.default_rng([seed, 6]))
    if seed // len(WRONG) % 2:
        twists *= 0.1
        twists[:, 3] = 10.0 * (
            1.0 + 0.03 * np.random.default_rng([seed, 7]).standard_normal(FRAMES)
        )
    gains, rays = ring_gains(lidar, np.random.default_rng([seed, 2])), camera_rays(camera)
    clock = Clock(camera.time_offset_s or 0.0, camera.readout_s or 0.0, camera.height_px)
    images, made = [], {}
    for frame, T_world_lidar in enumerate(drive.T_world_lidar):
        rng = np.random.default_rng([seed, 3, frame])
        made[f"cloud_{frame}"] = scan(drive.world, lidar, gains, T_world_lidar, rng=rng)
        poses = _poses(T_world_lidar, camera.T_camera_lidar, clock, twists[frame])
        images.append(render_rolling(drive.world, rays, poses, rng))
    return {**made, "images": np.array(images), "twists": twists}


def _poses(
    T_world_lidar: Array, T_camera_lidar: Array, clock: Clock, twist: Array
) -> Iterator[Array]:
    """T_world_camera of each strip of rows."""
    for row in range(0, clock.height_px, STRIP_PX):
        middle = row + (min(STRIP_PX, clock.height_px - row) - 1) / 2
        step = gtsam.Pose3.Expmap(twist * clock.times_s(np.array([middle]))[0]).matrix()
        yield relative_transform(T_world_lidar @ step, T_camera_lidar)


def render_rolling(
    world: World, rays: CameraRays, poses: Iterator[Array], rng: np.random.Generator
) -> NDArray[np.uint8]:
    """An image whose strips of rows are taken from poses of their own."""
    strips = []
    for number, T_world_camera in enumerate(poses):
        rows = slice(number * STRIP_PX, (number + 1) * STRIP_PX)
        some = CameraRays(rays.directions[rows], rays.blind[rows], rays.pixel_rad)
        strips.append(trace_light(world, some, T_world_camera))
    return develop(np.concatenate(strips), rng)
