"""What the network is shown, what is made of its flow, and whether its word is to be trusted."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import calibgraph
from calibgraph import (
    Camera,
    Dataset,
    DatasetError,
    Verdict,
    evaluate,
    load_dataset,
    load_rig,
    perturb,
)
from calibgraph.matching.cmrnext import CmrNextMatcher, confidence, probe
from calibgraph.matching.cmrnext.architecture import Architecture
from calibgraph.matching.cmrnext.inputs import (
    LidarImage,
    View,
    encode_depth,
    halve_lidar,
    lidar_channels,
    network_size,
    rgb_tensor,
)
from calibgraph.matching.cmrnext.network import CmrNext, Flow
from calibgraph.trust.solution_checks import Matching, with_matching
from tests.conftest import KANNALA, RADTAN5, SAMPLE, Call, make_camera
from tests.matching.cmrnext.test_checkpoint import good_content, saved

Array = NDArray[np.float64]


def cloud_before(camera: Camera, count: int, *, seed: int = 0) -> NDArray[np.float32]:
    """(n, 4) points in front of a camera, in the LiDAR frame."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform([5, 5], [camera.width_px - 5, camera.height_px - 5], (count, 2))
    depth = rng.uniform(4, 60, (count, 1))
    k = camera.intrinsics_px
    plane = (pixels - [k.cx, k.cy]) / [k.fx, k.fy]
    points = np.column_stack([plane * depth, depth])
    T = np.linalg.inv(camera.T_camera_lidar)
    lidar = points @ T[:3, :3].T + T[:3, 3]
    return np.column_stack([lidar, rng.uniform(0, 1, count)]).astype(np.float32)


def test_the_nearest_point_of_a_pixel_is_shown() -> None:
    camera = make_camera()
    ray = np.array([100.25 - 607, 50.75 - 185]) / [718, 710]
    in_camera = np.array([[*(ray * z), z, 1.0] for z in (30.0, 10.0, 20.0)])
    cloud = (in_camera @ np.linalg.inv(camera.T_camera_lidar).T).astype(np.float32)
    seen = LidarImage.render(cloud, camera.T_camera_lidar, View(camera))
    assert seen.point_index.tolist() == [1]
    assert seen.cells.tolist() == [[50, 100]]
    np.testing.assert_allclose(seen.pixels_px, [[100.25, 50.75]], atol=1e-4)
    assert seen.image(seen.depth_m)[50, 100] == pytest.approx(10.0)
    assert np.count_nonzero(seen.image(seen.depth_m)) == 1


def test_points_behind_and_beside_are_not_shown() -> None:
    camera = make_camera()
    in_camera = np.array([[0, 0, -5, 1], [50, 0, 5, 1], [0, 0, 2000, 1], [0, 0, 5, 1.0]])
    cloud = (in_camera @ np.linalg.inv(camera.T_camera_lidar).T).astype(np.float32)
    assert LidarImage.render(cloud, camera.T_camera_lidar, View(camera)).point_index.tolist() == [3]


def test_points_seen_through_something_nearer_are_left_out() -> None:
    """A screen of points at 5 m with gaps, a wall at 20 m behind it and beside it; and a slope."""
    camera = make_camera()
    view = View(camera)
    rows, columns = np.mgrid[100:200:6, 300:500:6].reshape(2, -1)
    screen = np.column_stack([columns, rows, np.full(len(rows), 5.0)])
    wall_rows, wall_columns = np.mgrid[103:200:6, 303:900:6].reshape(2, -1)
    wall = np.column_stack([wall_columns, wall_rows, np.full(len(wall_rows), 20.0)])
    image = np.concatenate([screen, wall])
    k = camera.intrinsics_px
    plane = (image[:, :2] + 0.5 - [k.cx, k.cy]) / [k.fx, k.fy]
    in_camera = np.column_stack([plane * image[:, 2:], image[:, 2], np.ones(len(image))])
    cloud = (in_camera @ np.linalg.inv(camera.T_camera_lidar).T).astype(np.float32)
    kept = LidarImage.render(cloud, camera.T_camera_lidar, view).without_occluded()
    is_wall = kept.point_index >= len(screen)
    assert np.count_nonzero(~is_wall) == len(screen)
    behind = (image[:, 0] > 310) & (image[:, 0] < 480) & (image[:, 1] > 110) & (image[:, 1] < 185)
    assert not (behind & (image[:, 2] == 20))[kept.point_index].any()
    beside = (image[:, 0] > 520) & (image[:, 2] == 20)
    assert np.count_nonzero(beside[kept.point_index]) == np.count_nonzero(beside)


def test_the_ground_does_not_occlude_itself() -> None:
    camera = make_camera()
    x, y = np.meshgrid(np.geomspace(4, 60, 400), np.linspace(-15, 15, 400))
    cloud = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -1.7), x.ravel()])
    seen = LidarImage.render(cloud.astype(np.float32), camera.T_camera_lidar, View(camera))
    assert len(seen.without_occluded().depth_m) > 0.99 * len(seen.depth_m)


def test_halving_takes_the_mean_of_what_is_there() -> None:
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


def test_padding_has_the_mean_colour() -> None:
    image = np.full((100, 150, 3), 255, np.uint8)
    tensor = rgb_tensor(image, normalize=True)
    assert tensor.shape == (3, 128, 192)
    assert not tensor[:, 100:].any() and not tensor[:, :, 150:].any()
    np.testing.assert_allclose(tensor[:, 0, 0], (1 - np.array([0.485, 0.456, 0.406])) / np.array(
        [0.229, 0.224, 0.225]), rtol=1e-6)  # fmt: skip


@pytest.mark.parametrize(("model", "distortion"), [("pinhole", RADTAN5), ("fisheye", KANNALA)])
def test_distortion_is_taken_out_and_put_back(model: str, distortion: tuple[float, ...]) -> None:
    """A dot in the recorded image is seen where a pinhole would, and comes back to where it was."""
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


@pytest.fixture(scope="module")
def sample() -> Dataset:
    return load_dataset(SAMPLE)


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """An untrained network."""
    return saved(tmp_path / "random.tar", good_content())


@pytest.fixture
def far_weights(tmp_path: Path) -> Path:
    """An untrained network that says it was trained for errors of 20 deg and 1.5 m."""
    content = good_content()
    content["config"] |= {"max_r": 20.0, "max_t": 1.5}
    return saved(tmp_path / "far.tar", content)


def with_flow(
    matcher: CmrNextMatcher,
    monkeypatch: pytest.MonkeyPatch,
    truth: dict[str, Array],
    *,
    by_heart: bool = False,
) -> None:
    """Replace the network by one that finds the truth; without the image only if by heart."""

    def matches(network: object, jobs: list) -> list:  # type: ignore[type-arg]
        from calibgraph.matching.cmrnext.matcher import _table

        tables = []
        for job in jobs:
            lidar = LidarImage.render(job.cloud, job.T_camera_lidar, job.view)
            sees = by_heart or job.image.std(axis=(0, 1)).any()
            T = truth[job.name] if sees else job.T_camera_lidar
            points = job.cloud[lidar.point_index, :3].astype(np.float64)
            target = job.view.project(points @ T[:3, :3].T + T[:3, 3])
            full = np.zeros((2, *network_size(*lidar.shape)), np.float32)
            full[:, lidar.cells[:, 0], lidar.cells[:, 1]] = (target - lidar.pixels_px).T
            coarse = np.stack([np.zeros_like(full[0]), np.ones_like(full[0])])[:, ::8, ::8]
            tables.append(_table(job, lidar, full, coarse, 8))
        return tables

    monkeypatch.setattr(matcher, "_matches", matches)


@pytest.mark.parametrize("estimate", ["frame", "joint"])
def test_true_flow_gives_the_true_poses(
    sample: Dataset, far_weights: Path, monkeypatch: pytest.MonkeyPatch, estimate: str
) -> None:
    """Sub-pixel consistent: half a pixel of shift would be 0.04 deg. Start 2 deg, 0.2 m off."""
    truth = load_rig(SAMPLE / "reference.yaml")
    matcher = CmrNextMatcher([far_weights, far_weights], estimate=estimate)
    with_flow(matcher, monkeypatch, truth.T_camera_lidar)
    result = calibgraph.calibrate(sample.select("0:5"), matcher=matcher)
    for error in evaluate(result.rig, truth).cameras.values():
        assert error.rotation_error_deg < 1e-3
        assert error.translation_error_cm < 0.02
    assert result.verdict.status == "PASS"
    table = result.correspondences
    assert table is not None and table.point_index is not None
    rows = np.flatnonzero(table.frame == 3)[::500]
    cloud = sample.frames[3].load_cloud()
    np.testing.assert_array_equal(cloud[table.point_index[rows], :3], table.points_lidar_m[rows])
    assert table.metadata["confidence"] == "uncalibrated"
    assert table.metadata["schedule"][0]["sha256"]


@pytest.mark.slow
def test_a_network_that_knows_its_rig_by_heart_is_found_out(
    sample: Dataset, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its poses are right, and would be the same on any other car."""
    truth = load_rig(SAMPLE / "reference.yaml")
    matcher = CmrNextMatcher([weights])
    with_flow(matcher, monkeypatch, truth.T_camera_lidar, by_heart=True)
    result = calibgraph.calibrate(sample.select("0:5"), truth, matcher=matcher)
    assert result.verdict.status == "FAIL"
    assert all("even without the image" in reason for reason in result.verdict.reasons)


@pytest.mark.slow
def test_frames_beyond_the_range_of_training_are_dropped(
    sample: Dataset, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Trained for 1 deg, asked to correct 10: what it says is not used, unless all say so."""
    truth = load_rig(SAMPLE / "reference.yaml")
    far = {name: np.array(T) for name, T in truth.T_camera_lidar.items()}
    far["left"][:3, :3] = Rotation.from_rotvec([0.0, 0.2, 0.0]).as_matrix() @ far["left"][:3, :3]
    matcher = CmrNextMatcher([weights])
    with_flow(matcher, monkeypatch, far)
    result = calibgraph.calibrate(sample.select("0:2"), truth, matcher=matcher)
    failed = result.correspondences.metadata["failed_frames"]  # type: ignore[union-attr]
    assert failed["front_left"] == [] and len(failed["left"]) == 2
    assert result.camera_verdicts["left"].status == "FAIL"
    assert any("100% of the frames failed" in r for r in result.camera_verdicts["left"].reasons)


@pytest.mark.slow
def test_an_untrained_network_is_found_out(sample: Dataset, weights: Path) -> None:
    """It gives back its start, consistently over all frames: only the displaced start tells."""
    result = calibgraph.calibrate(
        sample.select("0:5"), matcher=CmrNextMatcher([weights], iterations=1, half_resolution=True)
    )
    assert result.verdict.status == "FAIL"
    for verdict in result.camera_verdicts.values():
        assert any("of a displaced start remains" in reason for reason in verdict.reasons)


def test_untrained_weights_fail_on_the_command_line(
    weights: Path, tmp_path: Path, call: Call
) -> None:
    out = tmp_path / "out"
    files = ("--weights", weights, weights, weights)
    code, _, text = call(
        "calibrate", SAMPLE, "--frames", "0:1", "--matcher", "cmrnext", *files, "--out", out,
        "--half-resolution", "--iterations", 2,
    )  # fmt: skip
    assert code == 1
    assert "FAIL" in text
    table = calibgraph.load_correspondences(out / "correspondences.parquet")
    assert len(table.metadata["schedule"]) == 3
    assert table.metadata["half_resolution"] is True
    # The table alone can be solved again, without the network, and says the same.
    code, _, text = call("solve", SAMPLE, out / "correspondences.parquet", "--out", tmp_path / "o")
    assert code == 1 and "of a displaced start remains" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--matcher", "cmrnext"), "needs weights"),
        (("--matcher", "cmrnext", "--weights", "nowhere.tar"), "no such file of weights"),
        (("--weights", "a.tar"), "--weights is for --matcher cmrnext only"),
        (("--estimate", "joint"), "--estimate is for --matcher cmrnext only"),
        (("--matcher", "cmrnext", "--weights", "{w}", "--estimate", "both"), "known are frame"),
        (("--matcher", "cmrnext", "--weights", "{w}", "--device", "tpu"), "known are auto, cpu"),
    ],
)
def test_wrong_options_are_refused(
    weights: Path, call: Call, tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    given = [text.format(w=weights) for text in arguments]
    code, _, line = call("calibrate", SAMPLE, *given, "--out", tmp_path / "o")
    assert code == 2
    assert message in line and line.count("\n") == 1


def test_clouds_without_intensity_are_refused_where_it_is_needed() -> None:
    camera = make_camera()
    cloud = cloud_before(camera, 100)
    cloud[:, 3] = np.nan
    seen = LidarImage.render(cloud, camera.T_camera_lidar, View(camera))
    with pytest.raises(DatasetError, match="intensity"):
        lidar_channels(seen, Architecture(reflectance=True), 160.0)
    assert lidar_channels(seen, Architecture(), 160.0).shape[0] == 1


def test_intensities_of_bytes_become_unit() -> None:
    camera = make_camera()
    cloud = cloud_before(camera, 100)
    unit = LidarImage.render(cloud, camera.T_camera_lidar, View(camera))
    cloud[:, 3] *= 255
    same = LidarImage.render(cloud, camera.T_camera_lidar, View(camera))
    np.testing.assert_allclose(same.intensity, unit.intensity, rtol=1e-5)


@pytest.mark.slow
def test_a_batch_gives_what_single_images_give(sample: Dataset, weights: Path) -> None:
    one, four = (
        CmrNextMatcher([weights], batch=size, iterations=1).match(
            sample.select("0:1"), sample.rig, round_index=0, progress=lambda *_: None
        )
        for size in (1, 4)
    )
    assert len(one) == len(four)
    np.testing.assert_allclose(one.pixels_px, four.pixels_px, atol=1e-3)


def test_predicted_sigmas_become_information(sample: Dataset, tmp_path: Path) -> None:
    content = good_content(Architecture(width=8, uncertainty="nll"))
    content["config"]["uncertainty"] = True
    matcher = CmrNextMatcher([saved(tmp_path / "nll.tar", content)], iterations=1)
    table = matcher.match(sample.select("0:1"), sample.rig, round_index=0, progress=lambda *_: None)
    assert table.information_px is not None
    assert table.metadata["confidence"] == "predicted"
    sigma = table.information_px[:, [0, 2]] ** -0.5
    np.testing.assert_allclose(table.confidence, (2 / sigma.sum(axis=1)).clip(1e-3, 1), rtol=1e-5)


def test_confidence_falls_with_every_doubt() -> None:
    sure = confidence.from_flow(np.zeros(1), np.ones(1))
    assert 0.9 < sure[0] <= 1
    assert confidence.from_flow(np.full(1, 2.0), np.ones(1)) < 0.5 * sure
    assert confidence.from_flow(np.zeros(1), np.full(1, 1 / 81)) < 0.6 * sure
    assert confidence.lower_by_residuals(sure, np.full(1, 4.0)) == pytest.approx(sure / 2)
    assert confidence.from_flow(np.array([np.nan]), np.ones(1)) > 0  # and no NaN


def test_the_probe_tells_measuring_from_following() -> None:
    camera = make_camera()
    rig = calibgraph.Rig(cameras={"camera": camera})
    cloud = cloud_before(camera, 2000)
    T_two = probe.displace(camera.T_camera_lidar, (1.0, 0.1), np.random.default_rng(0))
    moved = T_two @ np.linalg.inv(camera.T_camera_lidar)
    assert np.degrees(Rotation.from_matrix(moved[:3, :3]).magnitude()) == pytest.approx(
        0.7 * np.sqrt(3), rel=1e-6
    )
    rng = np.random.default_rng(1)
    points = cloud[:, :3].astype(np.float64)

    def table(T: Array, share: float) -> calibgraph.Correspondences:
        """Matches that follow the start by a share, with noise."""
        truth, start = (
            camera.lens.project(points @ M[:3, :3].T + M[:3, 3])[0]
            for M in (rig.T_camera_lidar["camera"], T)
        )
        pixels = truth + share * (start - truth) + rng.normal(0, 1, truth.shape)
        return calibgraph.Correspondences.from_arrays(
            camera="camera", frame=0, pixels_px=pixels, points_lidar_m=points,
            point_index=np.arange(len(points)),
        )  # fmt: skip

    for share in (0.0, 0.4, 1.0):
        found = probe.remaining_share(camera, camera.T_camera_lidar, T_two, table(T_two, share))
        # Slope of 4000 values with noise 1 over motions of about 10 px: sigma 2e-3.
        assert found == pytest.approx(share, abs=0.01)
    few = table(T_two, 0.0).select(slice(0, 10))
    assert np.isnan(probe.remaining_share(camera, camera.T_camera_lidar, T_two, few))


@pytest.mark.parametrize(
    ("matching", "status"),
    [
        (Matching(), "PASS"),
        (Matching(start_dependence=0.1, recall=0.1, failed_share=0.1), "PASS"),
        (Matching(start_dependence=0.3), "WARN"),
        (Matching(start_dependence=0.9), "FAIL"),
        (Matching(start_dependence=float("nan")), "FAIL"),
        (Matching(recall=0.4), "WARN"),
        (Matching(recall=1.0), "FAIL"),
        (Matching(recall=-0.5), "PASS"),
        (Matching(failed_share=0.5), "WARN"),
        (Matching(failed_share=1.0), "FAIL"),
    ],
)
def test_the_verdict_heeds_the_matcher(matching: Matching, status: str) -> None:
    verdict = with_matching(Verdict(), matching)
    assert verdict.status == status
    assert len(verdict.reasons) == (status != "PASS")


@pytest.mark.slow
def test_perturbed_starts_are_matched_like_others(sample: Dataset, weights: Path) -> None:
    """A guess from which a camera sees nothing of the cloud is said to be one."""
    turned = perturb(sample.rig, rotation_deg=180, translation_m=0, seed=3)
    with pytest.raises(calibgraph.CalibrationError, match="usable correspondences"):
        calibgraph.calibrate(sample.select("0:1"), turned, CmrNextMatcher([weights], iterations=1))


def test_networks_are_for_evaluation(weights: Path) -> None:
    matcher = CmrNextMatcher([weights, weights])
    assert matcher.networks[0] is matcher.networks[1]  # loaded once
    model = matcher.networks[0].model
    assert isinstance(model, CmrNext) and not model.training
    assert isinstance(
        model(torch.zeros(1, 3, 128, 128), torch.zeros(1, 25, 128, 128), iterations=1), Flow
    )


def test_a_missing_torch_is_said_in_one_line(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in list(sys.modules):
        if name.startswith("calibgraph.matching.cmrnext"):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    code, _, line = call("weights", "iter1.tar")
    assert code == 2
    assert "pip install 'calibgraph[learned]'" in line and line.count("\n") == 1


def test_a_table_carries_what_its_matcher_said(pair: calibgraph.Rig) -> None:
    """The verdict of a later solve heeds it, and refuses nonsense in a line."""
    table = calibgraph.simulate_correspondences(pair, frames=8, matches=200)
    assert calibgraph.solve(pair, table).verdict.status == "PASS"
    said = replace(table, metadata={"start_dependence": {"left": 0.9}})
    result = calibgraph.solve(pair, said)
    assert result.camera_verdicts["left"].status == "FAIL"
    assert result.camera_verdicts["right"].status == "PASS"
    for nonsense in ({"left": "high"}, {"left": True}, 3, [1]):
        with pytest.raises(calibgraph.CorrespondenceError, match="recall"):
            calibgraph.solve(pair, replace(table, metadata={"recall": nonsense}))


def test_a_matchers_own_error_is_judged_once(pair: calibgraph.Rig) -> None:
    """It is part of the error bar; with too few frames for one it stands alone."""
    for frames, reason in ((8, "sigma: rotation"), (3, "the matcher's own error: rotation")):
        table = calibgraph.simulate_correspondences(pair, frames=frames, matches=200)
        said = replace(table, metadata={"systematic_rotation_rad": 0.02})
        verdict = calibgraph.solve(pair, said).camera_verdicts["left"]
        assert verdict.status == "FAIL"
        rotations = [text for text in verdict.reasons if "rotation" in text]
        assert len(rotations) == 1 and rotations[0].startswith(reason)
