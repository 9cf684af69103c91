"""Simulated correspondences that are good, or wrong in one of many ways: see ``verdicts``."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks.accuracy.rig_changes import (
    compose_extrinsics,
    derangement,
    invert_extrinsics,
    random_offset,
    random_sign,
    to_transform,
    with_focal,
    with_lenses,
    with_principal_point,
    with_stereo,
)
from benchmarks.accuracy.worlds import RIGS, Problem, World
from calibgraph import Correspondences, Rig, concatenate, perturb, solve
from calibgraph.model.geometry import invert

Array = np.ndarray
Rng = np.random.Generator

Case = tuple[Rig, Correspondences, dict[str, Any]]
"""The rig with its guess, the table, and what was drawn for this kind of case."""


def good(world: World, rng: Rng) -> Case:
    """Nothing is wrong."""
    return world.guess(), world.table(), {}


def random(world: World, rng: Rng) -> Case:
    """Every pixel is random."""
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


def tied(world: World, rng: Rng) -> Case:
    """One camera has no matches: a right relative pose ties it to another."""
    names = list(world.truth.cameras)
    without, other = (names[k] for k in rng.permutation(len(names))[:2])
    table = concatenate([world.table().of_camera(name) for name in names if name != without])
    return with_stereo(world.guess(), world.truth, without, other), table, {"without": without}


def shuffled(world: World, rng: Rng) -> Case:
    """Clouds are paired with images of other frames; the vehicle moves 1 to 2 m per frame."""
    order, how = _shuffle(world.frames, rng)
    T_start_lidar = [np.eye(4)]
    for _ in range(world.frames):
        turn, ahead = np.array([0, 0, rng.uniform(-2, 2)]), np.array([rng.uniform(1, 2), 0, 0])
        T_start_lidar.append(T_start_lidar[-1] @ to_transform(turn, ahead))

    def rig_at(frame: int) -> Rig:
        T_image_cloud = invert(T_start_lidar[order[frame]]) @ T_start_lidar[frame]
        return compose_extrinsics(world.truth, T_image_cloud)

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


def focal(world: World, rng: Rng, share: float) -> Case:
    """The rig's focal lengths are wrong."""
    factor = 1 + random_sign(rng) * share
    return with_focal(world.guess(), factor), world.table(), {"factor": factor}


def principal(world: World, rng: Rng) -> Case:
    """The rig's principal points are wrong by 15 to 40 px."""
    offset_px = random_offset(rng, 15, 40)
    guess = with_principal_point(world.guess(), offset_px)
    return guess, world.table(), {"offset_px": offset_px.tolist()}


def distorted(world: World, rng: Rng) -> Case:
    """The lenses distort, and the rig file has no distortion."""
    k1 = rng.uniform(-0.35, -0.25)
    lenses = with_lenses(world.truth, lambda camera: {"distortion": (k1, 0.1, 0.0, 0.0, 0.0)})
    guess = with_lenses(world.guess(), lambda camera: {"distortion": ()})
    return guess, replace(world, truth=lenses).table(), {"k1": k1}


def mirrored(world: World, rng: Rng) -> Case:
    """The clouds are mirrored: y is -y."""
    table = world.table()
    return world.guess(), replace(table, points_lidar_m=table.points_lidar_m * [1, -1, 1]), {}


def wall(world: World, rng: Rng) -> Case:
    """Each camera sees one wall and nothing else, opposite or oblique."""
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
        on_wall = points[met] * (distance / along[met])[:, None]  # pixels are unchanged
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
    """Another kind, with focal lengths wrong by 0.5 to 1 %, which weak geometry amplifies."""
    guess, table, drawn = of(world, rng)
    factor = 1 + random_sign(rng) * rng.uniform(0.005, 0.01)
    return with_focal(guess, factor), table, {**drawn, "factor": factor}


def two_poses(world: World, rng: Rng, share: float) -> Case:
    """A share of the matches agrees on another pose, of each camera or of the whole rig."""
    deg, m = rng.uniform(1, 10), rng.uniform(0.1, 1.0)
    whole = bool(rng.random() < 0.5)
    seed = int(rng.integers(2**31))
    if whole:
        axis, way = rng.standard_normal((2, 3))
        shift = m * way / np.linalg.norm(way)
        other = compose_extrinsics(
            world.truth, to_transform(deg * axis / np.linalg.norm(axis), shift)
        )
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
    """All frames share an error of the matcher, which no table can distinguish from a pose."""
    size, angle = rng.uniform(5, 15), rng.uniform(0, 2 * np.pi)
    table = world.table()
    pixels = table.pixels_px + size * np.array([np.cos(angle), np.sin(angle)])
    return world.guess(), replace(table, pixels_px=pixels), {"offset_px": size}


def time_offset(world: World, rng: Rng) -> Case:
    """Clouds and images are 20 to 100 ms apart, on a drive of varying speed and yaw rate."""
    seconds = random_sign(rng) * rng.uniform(0.02, 0.1)
    speed, yaw = rng.uniform(0, 15, world.frames), rng.uniform(-20, 20, world.frames)

    def rig_at(frame: int) -> Rig:
        turn, shift = np.array([0, 0, yaw[frame]]), np.array([speed[frame], 0, 0])
        return compose_extrinsics(world.truth, to_transform(seconds * turn, seconds * shift))

    return world.guess(), world.table(rig_at), {"seconds": seconds}


def units(world: World, rng: Rng) -> Case:
    """The points are in millimetres."""
    table = world.table()
    return world.guess(), replace(table, points_lidar_m=1000 * table.points_lidar_m), {}


def inverted_guess(world: World, rng: Rng) -> Case:
    """The guess is T_lidar_camera."""
    return invert_extrinsics(world.guess()), world.table(), {}


def axes_guess(world: World, rng: Rng) -> Case:
    """The guess has cameras with the LiDAR's axes."""
    transforms = {}
    for name, T in world.guess().T_camera_lidar.items():
        transforms[name] = np.eye(4)
        transforms[name][:3, 3] = T[:3, :3].T @ T[:3, 3]
    return world.truth.moved_to(transforms), world.table(), {}


KINDS: dict[str, Callable[[World, Rng], Case]] = {
    "good": good,
    "tied": tied,
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
"""No table can distinguish these from another pose: they show a limit, and are not counted."""

_RIGS_OF = {"distorted": ("pair", "wide_pair", "surround")}  # a fisheye always has coefficients


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
