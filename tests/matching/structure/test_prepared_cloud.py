from __future__ import annotations

import numpy as np
from scipy.stats import rankdata

import calibgraph
from calibgraph.matching.structure.prepared_cloud import PreparedCloud
from tests.conftest import SAMPLE, make_camera


def test_it_is_detected_whether_a_cloud_was_seen_from_its_origin() -> None:
    cloud = calibgraph.load_dataset(SAMPLE).frames[0].load_cloud()
    assert PreparedCloud.from_points(cloud).seen_from_origin
    cloud[:, 2] += 2.0  # as in a frame on the ground
    raised, camera = PreparedCloud.from_points(cloud), make_camera((1.0, 2.0, 3.0))
    assert not raised.seen_from_origin
    np.testing.assert_allclose(raised.viewpoint_lidar_m(camera), [1.0, 2.0, 3.0], atol=1e-12)


def test_ranks_of_intensities_are_those_of_scipy() -> None:
    rng = np.random.default_rng(0)
    cloud = np.column_stack([rng.normal(0, 20, (500, 3)), rng.integers(0, 30, 500)])
    cloud = cloud[np.linalg.norm(cloud[:, :3], axis=1) > 2.0].astype(np.float32)
    ranks = PreparedCloud.from_points(cloud).intensity_rank
    np.testing.assert_allclose(ranks, rankdata(cloud[:, 3]) / len(cloud))
