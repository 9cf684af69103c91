"""Tables of several places that state the errors which were drawn, with the truth beside them."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.graph.objective import pose_key
from calibgraph.model.correspondences import Correspondences, concatenate
from calibgraph.model.findings import MatcherFindings, error_components
from calibgraph.model.geometry import relative_transform, to_T_lidar_camera
from calibgraph.model.places import Places, as_groups
from calibgraph.model.rig import Intrinsics, RelativePose, Rig
from calibgraph.simulation.correspondences import MatcherErrors, simulate_correspondences
from calibgraph.solver.two_pass import optimize
from factors import ProjectionBlock, block_factor
from tests.draws.cameras import camera_at

Rng = np.random.Generator

FRAMES = 3
SIZES = MatcherFindings(**error_components().matchers["structure"])
FIFTH = MatcherErrors(noise_px=1.6**0.5, frame_noise_px=0.4**0.5, outlier_share=0.15)


@dataclass(frozen=True)
class Drawn:
    """What one draw solves.

    Attributes:
        rig: the true extrinsics; relative poses, if any, as they were measured.
        table: the correspondences.
        aligned: per camera, (4, 4) T_camera_lidar that brings the distorted points nearest to the
            true pixels of all places.
    """

    rig: Rig
    table: Correspondences
    aligned: Mapping[str, Array] = field(default_factory=dict)


def distortions_at(points_lidar_m: Array) -> Array:
    """(3, n, 3) displacements in the LiDAR frame, by a unit of each scan distortion.

    Elevations that are all a radian higher; elevations twice as far from the horizon; a metre of
    motion ahead, over a turn that begins and ends behind.
    """
    x, y, z = points_lidar_m.T
    level, heading = np.hypot(x, y), np.arctan2(y, x)
    elevation = np.column_stack([-z * np.cos(heading), -z * np.sin(heading), level])
    motion = np.zeros_like(points_lidar_m)
    motion[:, 0] = heading / (2 * np.pi)
    return np.stack([elevation, elevation * np.arctan2(z, level)[:, None], motion])


def draw_places(
    places: int, matches: int, rng: Rng, *, frames: int = FRAMES, rounds: int = 1
) -> Drawn:
    """A table of several places that states the sizes of its errors.

    Args:
        places: how many.
        matches: of a camera in a frame.
        rng: draws the errors.
        frames: of a place in each round.
        rounds: how often all places are visited, one after the other.
    """
    truth, there = stereo(), []
    whole = np.repeat(SIZES.rigid_sigmas, 3)
    bends = np.array(SIZES.bend_sigmas) * rng.standard_normal(3)
    at_place = np.repeat([SIZES.place_rotation_rad, SIZES.place_translation_m], 3)
    cloud = np.sqrt(1 - SIZES.camera_share) * whole * rng.standard_normal(6)
    cameras = np.sqrt(SIZES.camera_share) * whole * rng.standard_normal((2, 6))
    everywhere = displaced(truth, cloud, cameras)
    tables, names = [], [list[int]() for _ in range(places)]
    true_points = []
    for visit in range(places * rounds):
        place = visit % places
        if visit < places:
            moved = displaced(everywhere, at_place * rng.standard_normal(6), np.zeros((2, 6)))
            there.append(displaced(moved, np.zeros(6), draw_cameras(truth, matches, rng)))
        table = simulate_correspondences(
            there[place],
            frames=frames,
            matches=matches,
            errors=FIFTH,
            seed=int(rng.integers(2**31)),
        )
        points = table.points_lidar_m
        bent = points + np.tensordot(bends, distortions_at(points), axes=1)
        true_points.append(points)
        tables.append(replace(table, points_lidar_m=bent, frame=table.frame + frames * visit))
        names[place] += range(frames * visit, frames * (visit + 1))
    joined = concatenate(tables).with_findings(SIZES)
    aligned = align(truth, joined, np.concatenate(true_points))
    return Drawn(truth, joined.with_places(Places(places=as_groups(names))), aligned)


def align(truth: Rig, table: Correspondences, true_points_m: Array) -> dict[str, Array]:
    """Per camera, the pose that brings the table's points nearest to the true ones' pixels."""
    found: dict[str, Array] = {}
    for number, (name, camera) in enumerate(truth.cameras.items()):
        rows, T = table.camera_index == number, camera.T_camera_lidar
        pixels, _ = camera.lens.project(true_points_m[rows] @ T[:3, :3].T + T[:3, 3])
        block = ProjectionBlock(camera.lens, table.points_lidar_m[rows], pixels, scale=np.inf)
        graph = gtsam.NonlinearFactorGraph()
        graph.add(block_factor(pose_key((name,), name), block))
        found |= optimize(graph, (name,), {name: T}).T_camera_lidar
    return found


def draw_cameras(truth: Rig, matches: int, rng: Rng) -> Array:
    """(2, 6) displacement of each camera's matches at a place, in the shape of its information."""
    table = simulate_correspondences(
        truth, frames=1, matches=matches, errors=FIFTH, seed=int(rng.integers(2**31))
    )
    steps = []
    for name, camera in truth.cameras.items():
        rows = table.of_camera(name)
        block = ProjectionBlock(camera.lens, rows.points_lidar_m, rows.pixels_px)
        hessian = block.sums(to_T_lidar_camera(camera.T_camera_lidar)).hessian
        variance = SIZES.place_variance * FIFTH.noise_px**2
        root = np.linalg.cholesky(variance * np.linalg.inv(hessian))
        steps.append(root @ rng.standard_normal(6))
    return np.array(steps)


def displaced(rig: Rig, cloud: Array, cameras: Array) -> Rig:
    """The rig with its cloud and its cameras displaced."""
    T_cloud = gtsam.Pose3.Expmap(cloud).matrix()
    return rig.moved_to(
        {
            name: gtsam.Pose3.Expmap(xi).matrix() @ T @ T_cloud
            for (name, T), xi in zip(rig.T_camera_lidar.items(), cameras, strict=True)
        }
    )


def stereo() -> Rig:
    """A pair like KITTI's, half a metre apart."""
    lens = Intrinsics(fx=718.0, fy=718.0, cx=607.0, cy=185.0)
    places_m = {"left": (0.3, 0.1, -0.1), "right": (0.3, -0.44, -0.1)}
    return Rig(cameras={n: camera_at((1241, 376), lens, xyz) for n, xyz in places_m.items()})


def tied(drawn: Drawn, rng: Rng, *, deg: float, cm: float) -> Drawn:
    """The relative pose of the cameras is measured, with an error of this size."""
    sigmas = {"rotation_sigma_rad": np.radians(deg), "translation_sigma_m": cm / 100}
    error = np.repeat([*sigmas.values()], 3) * rng.standard_normal(6)
    T_left_right = relative_transform(*drawn.rig.T_camera_lidar.values())
    measured = T_left_right @ gtsam.Pose3.Expmap(error).matrix()
    pair = RelativePose(a="left", b="right", T_a_b=measured, **sigmas)
    return replace(drawn, rig=drawn.rig.model_copy(update={"relative_poses": (pair,)}))
