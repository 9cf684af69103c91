"""A simulated recording: the dataset of a rig that drives along a street."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from calibgraph.arrays import Array
from calibgraph.files import require_own_folder, write_atomically, write_bytes, written_together
from calibgraph.io.rigs import REFERENCE_FILE, RIG_FILE
from calibgraph.model.geometry import relative_transform
from calibgraph.model.metrics import perturb
from calibgraph.model.rig import Rig
from calibgraph.progress import Progress, no_progress
from calibgraph.simulation.cameras import camera_rays, develop, trace_light
from calibgraph.simulation.lidar import Lidar, SensorErrors, lidar_of, ring_gains, scan
from calibgraph.simulation.mesh import Mesh
from calibgraph.simulation.solids import UNIT_X, UNIT_Y, UNIT_Z, to_transform
from calibgraph.simulation.street import (
    LANE_Y_M,
    Centreline,
    Layout,
    build_street,
    draw_layout,
    winding_line,
)
from calibgraph.simulation.world import World, build_world

SceneBuilder = Callable[[Centreline, float, np.random.Generator], Mesh]
MAX_STREET_M = 2000
"""Longer streets take gigabytes of memory."""
MAX_SIDE_PX, MAX_PIXELS = 16_000, 50_000_000
_LIDAR_Z_M = 1.8
_SWAY_DEG, _SWAY_Y_M, _SWAY_STEP = (2.0, 0.5, 0.5), 0.25, 0.15
_JPEG_QUALITY = 92
_WRITTEN = ("lidar", "cameras", REFERENCE_FILE, RIG_FILE)  # rig.yaml last: it makes a dataset
# Each has its own random stream.
_WORLD, _DRIVE, _GAINS, _SCAN, _IMAGE, _, _LAYOUT = range(7)


@dataclass(frozen=True, eq=False)
class Drive:
    """A world, and the LiDAR's pose in every frame.

    Attributes:
        world: the street.
        T_world_lidar: (4, 4) per frame.
    """

    world: World
    T_world_lidar: tuple[Array, ...]


def simulate_street(  # noqa: PLR0913 - each of its own
    out: Path | str,
    rig: Rig,
    *,
    beams: int = 64,
    frames: int = 10,
    step_m: float = 4.0,
    seed: int = 0,
    rotation_deg: float = 5.0,
    translation_m: float = 0.3,
    sensor_errors: SensorErrors | None = None,
    vary_layout: bool = False,
    build_scene: SceneBuilder = build_street,
    progress: Progress | None = None,
) -> list[Path]:
    """Simulate a drive along a procedural street and write it as a dataset.

    All data of a frame are of one instant: no rolling shutter, no motion during a scan but that of
    ``sensor_errors``. The same arguments give the same files.

    Args:
        out: folder to write: ``rig.yaml`` (the guess), ``reference.yaml`` (the truth), ``lidar``
            and ``cameras``.
        rig: its extrinsics are the truth. The LiDAR is 1.8 m above the road, x forward, z up.
        beams: of the LiDAR: 16, 32 (a sector ahead and to the left), 64 or 128.
        frames: stops of the drive.
        step_m: mean distance between stops; 2 km in all at most.
        seed: of the street, the drive, the noise and the guess.
        rotation_deg: rotation error of the guess; see :func:`calibgraph.perturb`.
        translation_m: its translation error.
        sensor_errors: of the LiDAR; None for an ideal one.
        vary_layout: draw the street's width, curves, gardens, heights and objects by the
            seed. Otherwise all streets are laid out alike: kerbs and fronts are equally far away.
        build_scene: what the road leads through, if not a street: from the line of the road, the
            length that stays free and a generator.
        progress: called with the stage, its steps done, and their number.

    Returns:
        The rig files and the folders.

    Raises:
        ValueError: if an argument is out of range.
        FileError: if the folder holds files.
        CalibrationError: if Open3D is missing.
    """
    out = Path(out)
    lidar = replace(lidar_of(beams), errors=sensor_errors)
    guess = perturb(rig, rotation_deg=rotation_deg, translation_m=translation_m, seed=seed)
    _require_possible(out, rig, frames, step_m)
    progress = progress or no_progress
    progress("building the street", 0, frames)
    drive = build_drive(
        frames=frames, step_m=step_m, seed=seed, vary_layout=vary_layout, build_scene=build_scene
    )
    with written_together(out, last=RIG_FILE) as made:
        _write_scans(made / "lidar", lidar, drive, seed, progress=progress)
        _write_images(made / "cameras", rig, drive, seed, progress=progress)
        rig.save(made / REFERENCE_FILE)
        guess.save(made / RIG_FILE)
    return [out / name for name in reversed(_WRITTEN)]


def build_drive(
    *,
    frames: int,
    step_m: float = 4.0,
    seed: int = 0,
    vary_layout: bool = False,
    build_scene: SceneBuilder = build_street,
) -> Drive:
    """Build a street and drive along it; see :func:`simulate_street`."""
    rng = np.random.default_rng([seed, _WORLD])
    length_m = (frames - 1) * step_m * (1 + _SWAY_STEP)
    drawn = draw_layout(np.random.default_rng([seed, _LAYOUT])) if vary_layout else Layout()
    line = winding_line(length_m, drawn, rng)
    world = build_world(build_scene(line, length_m, rng), _draw_sun(rng), rng)
    return Drive(world, _draw_stops(line, frames, step_m, np.random.default_rng([seed, _DRIVE])))


def _draw_sun(rng: np.random.Generator) -> Array:
    """Unit vector towards the sun, 35 to 60 degrees above the horizon."""
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(35, 60))
    flat = np.cos(elevation)
    return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


def _draw_stops(
    line: Centreline, frames: int, step_m: float, rng: np.random.Generator
) -> tuple[Array, ...]:
    """T_world_lidar of every stop, with random offsets within the lane."""
    stops, s = [], 0.0
    for _ in range(frames):
        (x, y), heading_deg = line.at(s, LANE_Y_M + rng.normal(0, _SWAY_Y_M))
        yaw, pitch, roll = rng.normal(0, _SWAY_DEG)
        turns = (heading_deg + yaw) * UNIT_Z, pitch * UNIT_Y, roll * UNIT_X
        stops.append(to_transform((x, y, _LIDAR_Z_M), *turns))
        s += step_m * rng.uniform(1 - _SWAY_STEP, 1 + _SWAY_STEP)
    return tuple(stops)


def _write_scans(
    folder: Path, lidar: Lidar, drive: Drive, seed: int, *, progress: Progress
) -> None:
    gains = ring_gains(lidar, np.random.default_rng([seed, _GAINS]))
    for frame, T_world_lidar in enumerate(drive.T_world_lidar):
        progress("scanning", frame, len(drive.T_world_lidar))
        rng = np.random.default_rng([seed, _SCAN, frame])
        cloud = scan(drive.world, lidar, gains, T_world_lidar, rng=rng)
        write_atomically(folder / f"{frame:06d}.npy", partial(np.save, arr=cloud))


def _write_images(folder: Path, rig: Rig, drive: Drive, seed: int, *, progress: Progress) -> None:
    """All images, camera by camera: the rays of a camera take much memory."""
    frames = len(drive.T_world_lidar)
    for index, (name, camera) in enumerate(rig.cameras.items()):
        rays = camera_rays(camera)
        for frame, T_world_lidar in enumerate(drive.T_world_lidar):
            progress(f"rendering {name}", index * frames + frame, frames * len(rig.cameras))
            rng = np.random.default_rng([seed, _IMAGE, index, frame])
            T_world_camera = relative_transform(T_world_lidar, camera.T_camera_lidar)
            image = develop(trace_light(drive.world, rays, T_world_camera), rng)
            _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
            write_bytes(folder / name / f"{frame:06d}.jpg", data.tobytes())


def _require_possible(out: Path, rig: Rig, frames: int, step_m: float) -> None:
    if not (frames >= 1 and 0 <= step_m * frames <= MAX_STREET_M):
        raise ValueError(
            f"{frames} frames, {step_m} m apart: expected at least 1 frame, and 0 to "
            f"{MAX_STREET_M} m in all"
        )
    for name, camera in rig.cameras.items():
        width, height = camera.width_px, camera.height_px
        if max(width, height) > MAX_SIDE_PX or width * height > MAX_PIXELS:
            raise ValueError(
                f"camera {name!r} has {width}x{height} px: up to {MAX_SIDE_PX} a side and "
                f"{MAX_PIXELS} in all can be simulated"
            )
    require_own_folder(out)
