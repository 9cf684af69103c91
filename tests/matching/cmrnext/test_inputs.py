"""The network's inputs: projection, halving, encoding, padding, distortion."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from calibgraph.matching.cmrnext.inputs import (
    LidarImage,
    View,
    encode_depth,
    halve_lidar,
    network_size,
)
from calibgraph.matching.cmrnext.network import Architecture
from tests.conftest import KANNALA, RADTAN5, make_camera
from tests.matching.cmrnext.builders import cloud_before


def test_the_nearest_point_of_a_pixel_is_rendered() -> None:
    camera = make_camera()
    ray = np.array([100.25 - 607, 50.75 - 185]) / [718, 710]
    in_camera = np.array([[*(ray * z), z, 1.0] for z in (30.0, 10.0, 20.0)])
    cloud = (in_camera @ np.linalg.inv(camera.T_camera_lidar).T).astype(np.float32)
    lidar = LidarImage.render(cloud, camera.T_camera_lidar, View(camera))
    assert lidar.point_index.tolist() == [1]
    assert lidar.cells.tolist() == [[50, 100]]
    np.testing.assert_allclose(lidar.pixels_px, [[100.25, 50.75]], atol=1e-4)
    assert lidar.rasterize(lidar.depth_m)[50, 100] == pytest.approx(10.0)
    assert np.count_nonzero(lidar.rasterize(lidar.depth_m)) == 1


def test_points_behind_and_beside_are_not_rendered() -> None:
    camera = make_camera()
    in_camera = np.array([[0, 0, -5, 1], [50, 0, 5, 1], [0, 0, 2000, 1], [0, 0, 5, 1.0]])
    cloud = (in_camera @ np.linalg.inv(camera.T_camera_lidar).T).astype(np.float32)
    assert LidarImage.render(cloud, camera.T_camera_lidar, View(camera)).point_index.tolist() == [3]


def test_halving_takes_the_mean_of_pixels_with_points() -> None:
    channels = np.zeros((2, 4, 4), np.float32)
    channels[0, 0, 0], channels[0, 1, 1], channels[0, 2, 3] = 0.2, 0.4, 0.5
    channels[1, 0, 0], channels[1, 1, 1], channels[1, 2, 3] = 1.0, 0.0, 0.7
    expected = [[[0.3, 0], [0, 0.5]], [[0.5, 0], [0, 0.7]]]
    np.testing.assert_allclose(halve_lidar(channels), expected, rtol=1e-6)


def test_depth_is_encoded_as_published() -> None:
    """sin, cos per level, slow first, then the depth; all zero where there is no point."""
    depth = torch.tensor([[[[0.0, 0.3]]]])
    found = encode_depth(depth, Architecture(fourier_levels=3))[0, :, 0]
    assert not found[:, 0].any()
    waves = [f(np.pi * 0.3 * 2**level) for level in range(3) for f in (np.sin, np.cos)]
    np.testing.assert_allclose(found[:, 1], [*waves, 0.3], atol=1e-6)
    assert encode_depth(depth, Architecture(fourier_levels=-1)).shape[1] == 1
    with_intensity = encode_depth(torch.cat([depth, depth], 1), Architecture(reflectance=True))
    assert with_intensity.shape[1] == 26
    assert network_size(376, 1241) == (384, 1280)
    assert network_size(370, 1226) == (384, 1280)
    assert network_size(60, 100) == (128, 128)


def test_published_inputs_are_reproduced(reference_folder: Path) -> None:
    vectors = np.load(reference_folder / "cmrnext_golden.npz", allow_pickle=False)
    depth = torch.tensor(vectors["depth_norm"])[None, None]
    found = encode_depth(depth, Architecture())
    # sine and cosine of up to 6434 rad in float32: the argument alone is rounded by 5e-4.
    np.testing.assert_allclose(found, vectors["lidar_input"], atol=1e-3, rtol=0)


@pytest.mark.parametrize(("model", "distortion"), [("pinhole", RADTAN5), ("fisheye", KANNALA)])
def test_distortion_is_removed_and_added_again(model: str, distortion: tuple[float, ...]) -> None:
    """A dot moves to the pinhole's pixel, and back to its own."""
    camera = make_camera(model=model, distortion=distortion)
    view = View(camera)
    recorded = np.zeros((camera.height_px, camera.width_px, 3), np.uint8)
    dot = np.array([420.0, 250.0])
    cv2.circle(recorded, (420, 250), 6, (255, 255, 255), -1)
    weights = view.undistort(recorded)[:, :, 0].astype(np.float64)
    rows, columns = np.indices(weights.shape)
    centre = np.array([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum()
    back, on_image = view.distort(centre[None])
    assert on_image.all()
    assert np.linalg.norm(centre - dot) > 1  # it was distorted
    np.testing.assert_allclose(back[0], dot, atol=0.1)  # a disc's centre moves by curvature


def test_intensities_of_bytes_become_unit() -> None:
    camera = make_camera()
    cloud = cloud_before(camera, 100)
    unit = LidarImage.render(cloud, camera.T_camera_lidar, View(camera))
    cloud[:, 3] *= 255
    same = LidarImage.render(cloud, camera.T_camera_lidar, View(camera))
    np.testing.assert_allclose(same.intensity, unit.intensity, rtol=1e-5)
