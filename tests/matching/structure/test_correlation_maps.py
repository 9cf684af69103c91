from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

import calibgraph
from calibgraph.matching.structure.correlation_maps import CorrelationMaps, correlate
from calibgraph.matching.structure.directions import view_angles
from calibgraph.matching.structure.frame_cache import FrameCache
from calibgraph.parallel import core_pool
from tests.conftest import SAMPLE


def make_maps(rng: np.random.Generator) -> CorrelationMaps:
    smooth = rng.standard_normal((40, 30, 50)).cumsum(axis=1).cumsum(axis=2).astype(np.float32)
    points = rng.uniform([-8, -4, 5], [8, 4, 30], (40, 3))
    return CorrelationMaps(smooth, points, np.array([-0.5, -0.3]), 0.02)


def make_transforms(rng: np.random.Generator, count: int) -> np.ndarray:
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(rng.uniform(-0.3, 0.3, (count, 3))).as_matrix()
    T[:, :3, 3] = rng.uniform(-1, 1, (count, 3))
    return T


def literal_z_score(maps: CorrelationMaps, T: np.ndarray) -> float:
    """The sum of interpolated scores over its standard deviation, group by group."""
    total, variance = 0.0, maps._variance_floor
    height, width = maps.maps.shape[1:]
    for scores, point, of_group in zip(maps.maps, maps.points_lidar_m, maps.variances, strict=True):
        angles = view_angles((T[:3, :3] @ point + T[:3, 3])[None])[0]
        u, v = (angles - maps.origin_rad) / maps.step_rad
        if 0 <= u < width - 1 and 0 <= v < height - 1:
            total += map_coordinates(scores.astype(float), [[v], [u]], order=1)[0]
            variance += of_group
    return float(total / np.sqrt(variance))


def test_z_scores_are_those_of_the_literal_formula() -> None:
    rng = np.random.default_rng(0)
    maps, transforms = make_maps(rng), make_transforms(rng, 50)
    expected = [literal_z_score(maps, T) for T in transforms]
    np.testing.assert_allclose(maps.z_scores(transforms), expected, rtol=2e-3, atol=2e-3)


def test_with_dense_windows_the_right_pose_stands_out_more() -> None:
    data, rig = calibgraph.load_dataset(SAMPLE), calibgraph.load_rig(SAMPLE / "reference.yaml")
    frame, (name, camera) = data.frames[0], next(iter(rig.cameras.items()))
    cache = FrameCache()
    gray, cloud = cache.image(frame, name, camera), cache.cloud(frame)
    z_scores = {}
    with core_pool() as cores:
        for dense in (False, True):
            maps = correlate(
                [gray], [cloud], camera, cores,
                range_rad=0.3, max_windows=9000, dense=dense, seed=0,
            )  # fmt: skip
            z_scores[dense] = maps.blur(1.0).z_scores(camera.T_camera_lidar[None])[0]
    assert z_scores[True] > 1.2 * z_scores[False] > 0
