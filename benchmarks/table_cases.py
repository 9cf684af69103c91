"""Simulated correspondences that are good, or wrong in one of many ways; see ``verdicts.py``."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph import (
    Calibration,
    Camera,
    Correspondences,
    Intrinsics,
    MatcherErrors,
    RelativePose,
    Rig,
    concatenate,
    perturb,
    solve,
)
from calibgraph.simulation.correspondences import simulate_drive

Array = np.ndarray
Rng = np.random.Generator

FORWARD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
STEREO_SIGMA_DEG, STEREO_SIGMA_M = 0.1, 0.01


@dataclass(frozen=True, eq=False)
class Problem:
    """What calibgraph is given, and what is true.

    Attributes:
        truth: the rig with its true poses.
        calibrate: runs calibgraph on it.
        drawn: the numbers that were drawn, for the record.
    """

    truth: Rig
    calibrate: Callable[[], Calibration]
    drawn: dict[str, Any]


@dataclass(frozen=True, eq=False)
class World:
    """A true rig, what its matcher finds, and how far off the guess is."""

    truth: Rig
    frames: int
    matches: int
    errors: MatcherErrors
    depth_m: tuple[float, float]
    guess_deg: float
    guess_m: float
    seed: int

    @staticmethod
    def draw(rig: Rig, rng: Rng) -> World:
        """Any world that a matcher's table may come from."""
        seed = int(rng.integers(2**31))
        return World(
            truth=perturb(rig, rotation_deg=5, translation_m=0.1, seed=seed, uniform=True),
            frames=int(rng.integers(5, 41)),
            matches=int(np.exp(rng.uniform(np.log(50), np.log(500)))),
            errors=MatcherErrors(
                noise_px=rng.uniform(0.5, 2.0),
                frame_noise_px=rng.uniform(0.0, 1.5),
                outlier_share=rng.uniform(0.0, 0.3),
                informative_confidence=bool(rng.random() < 0.5),
            ),
            depth_m=(3.0, rng.uniform(20.0, 60.0)),
            guess_deg=rng.uniform(0.0, 20.0),
            guess_m=rng.uniform(0.0, 1.5),
            seed=seed,
        )

    def guess(self) -> Rig:
        """The truth, displaced."""
        return perturb(
            self.truth,
            rotation_deg=self.guess_deg,
            translation_m=self.guess_m,
            seed=self.seed + 1,
        )

    def table(self, rig_at: Callable[[int], Rig] | None = None) -> Correspondences:
        """What the matcher finds; ``rig_at`` as of :func:`simulate_drive`, else the truth."""
        return concatenate(
            list(
                simulate_drive(
                    rig_at or (lambda frame: self.truth),
                    frames=self.frames,
                    matches=self.matches,
                    errors=self.errors,
                    depth_m=self.depth_m,
                    seed=self.seed + 2,
                )
            )
        )

    def drawn(self) -> dict[str, Any]:
        """The numbers, without the rig."""
        values = {k: v for k, v in vars(self).items() if k not in ("truth", "errors")}
        return {**values, **asdict(self.errors)}


Case = tuple[Rig, Correspondences, dict[str, Any]]
"""The rig with its guess, the table, and what was drawn for this kind of case."""


def rigs() -> dict[str, Rig]:
    """The rigs, by name."""
    kitti = partial(_camera, size=(1241, 376), focal=719.0)
    wide = partial(_camera, size=(1920, 1200), focal=1450.0)
    side = partial(_camera, size=(1936, 1216), focal=1060.0)
    fish = partial(_camera, size=(1280, 960), focal=330.0, model="fisheye")
    return {
        "pair": Rig(cameras={"left": kitti((0.3, 0.27, -0.1)), "right": kitti((0.3, -0.27, -0.1))}),
        "wide_pair": Rig(
            cameras={
                "left": wide((0.5, 0.4, -0.3), distortion=(-0.11, 0.05, 0.001, -0.002, 0.004)),
                "right": wide((0.5, -0.4, -0.3), distortion=(-0.12, 0.06, -0.001, 0.001, 0.003)),
            }
        ),
        "surround": Rig(
            cameras={f"camera_{k}": side(_on_ring(k * 60, 0.8), yaw_deg=k * 60) for k in range(6)}
        ),
        "fisheyes": Rig(
            cameras={
                f"fisheye_{k}": fish(
                    _on_ring(k * 90, 1.0), yaw_deg=k * 90, distortion=(0.02, -0.004, 0.001, -0.0002)
                )
                for k in range(4)
            }
        ),
    }


def _camera(
    position_m: Sequence[float],
    *,
    size: tuple[int, int],
    focal: float,
    yaw_deg: float = 0.0,
    **lens: Any,
) -> Camera:
    width, height = size
    T = np.eye(4)
    T[:3, :3] = FORWARD @ Rotation.from_euler("z", -yaw_deg, degrees=True).as_matrix()
    T[:3, 3] = -T[:3, :3] @ np.array(position_m)
    intrinsics = Intrinsics(fx=focal, fy=0.995 * focal, cx=0.492 * width, cy=0.496 * height)
    return Camera(
        width_px=width, height_px=height, intrinsics_px=intrinsics, T_camera_lidar=T, **lens
    )


def _on_ring(angle_deg: float, radius_m: float) -> tuple[float, float, float]:
    angle = np.radians(angle_deg)
    return (radius_m * np.cos(angle), radius_m * np.sin(angle), -0.3)


RIGS = rigs()


def with_lenses(rig: Rig, change: Callable[[Camera], dict[str, Any]]) -> Rig:
    """The rig with some fields of every camera changed."""
    fields = Camera.model_fields
    cameras = {
        name: Camera(**{**{field: getattr(camera, field) for field in fields}, **change(camera)})
        for name, camera in rig.cameras.items()
    }
    return rig.model_copy(update={"cameras": cameras})


def with_focal(rig: Rig, factor: float) -> Rig:
    """The rig with focal lengths that are wrong by a factor."""

    def change(camera: Camera) -> dict[str, Any]:
        k = camera.intrinsics_px
        return {"intrinsics_px": k.model_copy(update={"fx": factor * k.fx, "fy": factor * k.fy})}

    return with_lenses(rig, change)


def with_stereo(rig: Rig, truth: Rig, a: str, b: str) -> Rig:
    """The rig with the true relative pose of two cameras in its file, as a stereo calibration."""
    T = truth.T_camera_lidar
    pair = RelativePose(
        a=a,
        b=b,
        T_a_b=T[a] @ np.linalg.inv(T[b]),
        rotation_sigma_rad=np.radians(STEREO_SIGMA_DEG),
        translation_sigma_m=STEREO_SIGMA_M,
    )
    return rig.model_copy(update={"relative_poses": (pair,)})


def inverted(rig: Rig) -> Rig:
    """The rig with T_lidar_camera where T_camera_lidar should be."""
    return rig.moved_to({name: np.linalg.inv(T) for name, T in rig.T_camera_lidar.items()})


def displacement(angles_deg: Array, shift_m: Array) -> Array:
    """(4, 4) from a rotation vector and a shift."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(angles_deg)).as_matrix()
    T[:3, 3] = shift_m
    return T


def lidar_moved(rig: Rig, T_lidar_points: Array) -> Rig:
    """The rig as it seems when points are given in a LiDAR frame of another time or place."""
    return rig.moved_to({name: T @ T_lidar_points for name, T in rig.T_camera_lidar.items()})


def sign(rng: Rng) -> float:
    """Plus or minus one."""
    return float(rng.choice([-1.0, 1.0]))


def good(world: World, rng: Rng) -> Case:
    """Nothing is wrong."""
    return world.guess(), world.table(), {}


def random(world: World, rng: Rng) -> Case:
    """Every correspondence is anywhere."""
    errors = replace(world.errors, outlier_share=1.0, informative_confidence=False)
    return world.guess(), replace(world, errors=errors).table(), {}


def swapped(world: World, rng: Rng) -> Case:
    """Two neighbouring cameras' matches have each other's names; their relative pose is known."""
    names = list(world.truth.cameras)
    first = int(rng.integers(len(names) - 1))
    a, b = names[first], names[first + 1]
    table = world.table()
    swap = {a: b, b: a}
    renamed = replace(table, cameras=tuple(swap.get(name, name) for name in table.cameras))
    return with_stereo(world.guess(), world.truth, a, b), renamed, {"swapped": [a, b]}


def shuffled(world: World, rng: Rng) -> Case:
    """Clouds and images of a vehicle on the move, 1 to 2 m from frame to frame, do not belong."""
    order, how = _shuffle(world.frames, rng)
    T_start_lidar = [np.eye(4)]
    for _ in range(world.frames):
        turn, ahead = np.array([0, 0, rng.uniform(-2, 2)]), np.array([rng.uniform(1, 2), 0, 0])
        T_start_lidar.append(T_start_lidar[-1] @ displacement(turn, ahead))

    def rig_at(frame: int) -> Rig:
        T_image_cloud = np.linalg.inv(T_start_lidar[order[frame]]) @ T_start_lidar[frame]
        return lidar_moved(world.truth, T_image_cloud)

    return world.guess(), world.table(rig_at), {"shuffle": how}


def _shuffle(count: int, rng: Rng) -> tuple[Array, str]:
    """Whose image each cloud gets: its neighbour's in turn, the next frame's, or any other's."""
    how = str(rng.choice(["neighbours", "next", "any"]))
    order = np.arange(count)
    if how == "next":
        return order + 1, how
    if how == "neighbours":
        return np.where(order % 2 == 0, order + 1, order - 1), how
    return derangement(count, rng), how


def derangement(count: int, rng: Rng) -> Array:
    """A random order in which nothing stays in its place."""
    while True:
        order = rng.permutation(count)
        if (order != np.arange(count)).all():
            return order


def focal(world: World, rng: Rng, share: float) -> Case:
    """The rig's focal lengths are wrong."""
    factor = 1 + sign(rng) * share
    return with_focal(world.guess(), factor), world.table(), {"factor": factor}


def principal(world: World, rng: Rng) -> Case:
    """The rig's principal points are wrong by 15 to 40 px."""
    size, angle = rng.uniform(15, 40), rng.uniform(0, 2 * np.pi)

    def change(camera: Camera) -> dict[str, Any]:
        k = camera.intrinsics_px
        moved = {"cx": k.cx + size * np.cos(angle), "cy": k.cy + size * np.sin(angle)}
        return {"intrinsics_px": k.model_copy(update=moved)}

    drawn = {"offset_px": size, "angle_deg": np.degrees(angle)}
    return with_lenses(world.guess(), change), world.table(), drawn


def distorted(world: World, rng: Rng) -> Case:
    """The lenses distort, and the rig says nothing of it."""
    k1 = rng.uniform(-0.35, -0.25)
    lenses = with_lenses(world.truth, lambda camera: {"distortion": (k1, 0.1, 0.0, 0.0, 0.0)})
    guess = with_lenses(world.guess(), lambda camera: {"distortion": ()})
    return guess, replace(world, truth=lenses).table(), {"k1": k1}


def mirrored(world: World, rng: Rng) -> Case:
    """The clouds are mirrored: y is -y."""
    table = world.table()
    return world.guess(), replace(table, points_lidar_m=table.points_lidar_m * [1, -1, 1]), {}


def wall(world: World, rng: Rng) -> Case:
    """All that each camera sees is one wall, opposite or oblique."""
    distance, tilt = rng.uniform(5, 30), rng.choice([0.0, rng.uniform(10, 70)])
    angle = rng.uniform(0, 2 * np.pi)
    slope = np.tan(np.radians(tilt)) * np.array([np.cos(angle), np.sin(angle)])
    normal = np.array([*slope, 1.0])  # normal . p = distance: met on the axis at that distance
    tables = []
    table = world.table()
    for name, T in world.truth.T_camera_lidar.items():
        rows = table.of_camera(name)
        points = rows.points_lidar_m @ T[:3, :3].T + T[:3, 3]
        along = points @ normal
        met = along > 0.02 * np.linalg.norm(points, axis=1)
        on_wall = points[met] * (distance / along[met])[:, None]  # its pixels stay what they are
        rows = rows.select(met)
        tables.append(replace(rows, points_lidar_m=(on_wall - T[:3, 3]) @ T[:3, :3]))
    return world.guess(), concatenate(tables), {"distance_m": distance, "tilt_deg": tilt}


def narrow_cone(world: World, rng: Rng) -> Case:
    """All matches lie in a small part of the image."""
    share, middle = rng.uniform(0.05, 0.15), rng.uniform(-0.3, 0.3, 2)
    tables = []
    table = world.table()
    for name, camera in world.truth.cameras.items():
        T, rows = camera.T_camera_lidar, table.of_camera(name)
        points = rows.points_lidar_m @ T[:3, :3].T + T[:3, 3]
        bundled = points[:, 2:] * np.column_stack(
            [middle + share * points[:, :2] / points[:, 2:], np.ones(len(points))]
        )
        errors = rows.pixels_px - camera.lens.project(points)[0]
        pixels = camera.lens.project(bundled)[0] + errors
        seen = camera.in_image(pixels)  # outliers may not be
        moved = replace(rows, pixels_px=pixels, points_lidar_m=(bundled - T[:3, 3]) @ T[:3, :3])
        tables.append(moved.select(seen))
    return world.guess(), concatenate(tables), {"share": share}


def far_away(world: World, rng: Rng) -> Case:
    """All matches are beyond 40 m."""
    return world.guess(), replace(world, depth_m=(40.0, 120.0)).table(), {}


def slightly_wrong_focal(world: World, rng: Rng, of: Callable[[World, Rng], Case]) -> Case:
    """Another kind, with focal lengths wrong by 0.5 to 1 %: what weak geometry makes much of."""
    guess, table, drawn = of(world, rng)
    factor = 1 + sign(rng) * rng.uniform(0.005, 0.01)
    return with_focal(guess, factor), table, {**drawn, "factor": factor}


def two_poses(world: World, rng: Rng, share: float) -> Case:
    """A share of the matches agrees on another pose, of each camera or of the whole rig."""
    deg, m = rng.uniform(1, 10), rng.uniform(0.1, 1.0)
    whole = bool(rng.random() < 0.5)
    seed = int(rng.integers(2**31))
    if whole:
        axis, way = rng.standard_normal((2, 3))
        shift = m * way / np.linalg.norm(way)
        other = lidar_moved(world.truth, displacement(deg * axis / np.linalg.norm(axis), shift))
    else:
        other = perturb(world.truth, rotation_deg=deg, translation_m=m, seed=seed)
    wrong = max(1, round(share * world.matches))
    tables = [
        replace(world, matches=max(1, world.matches - wrong)).table(),
        replace(world, truth=other, matches=wrong, seed=seed).table(),
    ]
    return world.guess(), concatenate(tables), {"deg": deg, "m": m, "whole_rig": whole}


def few_frames(world: World, rng: Rng) -> Case:
    """Two to five frames."""
    frames = int(rng.integers(2, 6))
    return world.guess(), replace(world, frames=frames).table(), {"few": frames}


def bias(world: World, rng: Rng) -> Case:
    """All frames share an error of the matcher: no table can tell it from another pose."""
    size, angle = rng.uniform(5, 15), rng.uniform(0, 2 * np.pi)
    table = world.table()
    pixels = table.pixels_px + size * np.array([np.cos(angle), np.sin(angle)])
    return world.guess(), replace(table, pixels_px=pixels), {"offset_px": size}


def time_offset(world: World, rng: Rng) -> Case:
    """Clouds and images are 20 to 100 ms apart, on a drive of varying speed and yaw rate."""
    seconds = sign(rng) * rng.uniform(0.02, 0.1)
    speed, yaw = rng.uniform(0, 15, world.frames), rng.uniform(-20, 20, world.frames)

    def rig_at(frame: int) -> Rig:
        turn, shift = np.array([0, 0, yaw[frame]]), np.array([speed[frame], 0, 0])
        return lidar_moved(world.truth, displacement(seconds * turn, seconds * shift))

    return world.guess(), world.table(rig_at), {"seconds": seconds}


def units(world: World, rng: Rng) -> Case:
    """The points are in millimetres."""
    table = world.table()
    return world.guess(), replace(table, points_lidar_m=1000 * table.points_lidar_m), {}


def inverted_guess(world: World, rng: Rng) -> Case:
    """The guess is T_lidar_camera."""
    return inverted(world.guess()), world.table(), {}


def axes_guess(world: World, rng: Rng) -> Case:
    """The guess has cameras with the LiDAR's axes."""
    poses = {}
    for name, T in world.guess().T_camera_lidar.items():
        poses[name] = np.eye(4)
        poses[name][:3, 3] = T[:3, :3].T @ T[:3, 3]
    return world.truth.moved_to(poses), world.table(), {}


KINDS: dict[str, Callable[[World, Rng], Case]] = {
    "good": good,
    "random": random,
    "swapped": swapped,
    "shuffled": shuffled,
    "focal_5": partial(focal, share=0.05),
    "focal_3": partial(focal, share=0.03),
    "focal_1": partial(slightly_wrong_focal, of=good),
    "principal": principal,
    "distorted": distorted,
    "mirrored": mirrored,
    "wall": wall,
    "narrow_cone": narrow_cone,
    "far_away": far_away,
    "wall_focal_1": partial(slightly_wrong_focal, of=wall),
    "cone_focal_1": partial(slightly_wrong_focal, of=narrow_cone),
    "far_focal_1": partial(slightly_wrong_focal, of=far_away),
    "two_poses_45": partial(two_poses, share=0.45),
    "two_poses_60": partial(two_poses, share=0.60),
    "two_poses_75": partial(two_poses, share=0.75),
    "few_frames": few_frames,
    "bias": bias,
    "time_offset": time_offset,
    "units": units,
    "inverted": inverted_guess,
    "axes": axes_guess,
}

UNDETECTABLE = ("bias",)
"""No table tells these from another pose: they show a limit, and are not counted."""

_RIGS_OF = {"distorted": ("pair", "wide_pair", "surround")}  # a fisheye always says its distortion


def rig_for(kind: str, seed: int) -> str:
    """The name of a case's rig."""
    names = _RIGS_OF.get(kind, tuple(RIGS))
    return names[seed % len(names)]


def table_problem(kind: str, rig: str, seed: int) -> Problem:
    """One case.

    Args:
        kind: one of KINDS.
        rig: one of RIGS.
        seed: of all that is drawn.
    """
    rng = np.random.default_rng([seed, zlib.crc32(kind.encode())])
    world = World.draw(RIGS[rig], rng)
    guess, table, drawn = KINDS[kind](world, rng)
    return Problem(
        truth=world.truth,
        calibrate=lambda: solve(guess, table),
        drawn={**world.drawn(), **drawn},
    )
