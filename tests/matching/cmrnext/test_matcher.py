"""The matcher cmrnext: true flow gives true poses; networks that only repeat something FAIL."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import calibgraph
from calibgraph import Calibration, Correspondences, Dataset, Rig, load_rig
from calibgraph.matching.cmrnext import CmrNextMatcher
from calibgraph.matching.cmrnext.flow_matching import FlowMatcher, MatchingJob, to_table
from calibgraph.matching.cmrnext.inputs import LidarImage, network_size
from tests.conftest import SAMPLE, require_near

Array = NDArray[np.float64]


def replace_networks(
    monkeypatch: pytest.MonkeyPatch, truth: dict[str, Array], *, memorised: bool = False
) -> None:
    """Let every network return the true flow; from a blank image only if it is memorised."""

    def match(network: FlowMatcher, job: MatchingJob) -> Correspondences:
        lidar = LidarImage.render(job.cloud, job.T_camera_lidar, job.view)
        informed = memorised or job.image.std(axis=(0, 1)).any()
        T = truth[job.name] if informed else job.T_camera_lidar
        points = job.cloud[lidar.point_index, :3].astype(np.float64)
        target = job.view.project(points @ T[:3, :3].T + T[:3, 3])
        full = np.zeros((2, *network_size(*lidar.shape)), np.float32)
        full[:, lidar.cells[:, 0], lidar.cells[:, 1]] = (target - lidar.pixels_px).T
        coarse = np.stack([np.zeros_like(full[0]), np.ones_like(full[0])])[:, ::8, ::8]
        return to_table(job, lidar, full, coarse, cell=8)

    monkeypatch.setattr(FlowMatcher, "match", match)


def check_true_poses(result: Calibration, table: Correspondences, dataset: Dataset) -> None:
    """Sub-pixel consistent: half a pixel of shift would be 0.04 deg. Start 2 deg, 0.2 m off."""
    require_near(result.rig, load_rig(SAMPLE / "reference.yaml"), deg=1e-3, cm=0.02)
    assert all(check.status == "PASS" for check in result.verdict.checks)
    assert result.verdict.status != "FAIL"  # WARN for 0.8 %: tables of five frames are no better
    cloud = dataset.frames[3].load_cloud()[:, :3]
    for point in table.points_lidar_m[table.frame == 3][::500]:
        assert (cloud == point).all(axis=1).any()
    assert table.metadata["confidence"] == "uncalibrated"
    assert table.metadata["schedule"][0]["sha256"]


def test_true_flow_gives_the_true_poses(
    sample: Dataset, far_weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of one camera: all three are matched below, with the checks on images."""
    replace_networks(monkeypatch, load_rig(SAMPLE / "reference.yaml").T_camera_lidar)
    alone = Rig(cameras={"left": sample.rig.cameras["left"]})
    data = replace(sample.select("0:5"), rig=alone)
    matcher = CmrNextMatcher([far_weights, far_weights])
    table = matcher.match(data, data.rig, round_index=0, progress=lambda *_: None)
    check_true_poses(calibgraph.solve(data.rig, table), table, data)


@pytest.mark.slow
def test_true_flow_passes_the_checks_on_images(
    sample: Dataset, far_weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Images of overlapping cameras may move it, by no more than their own error."""
    truth = load_rig(SAMPLE / "reference.yaml")
    replace_networks(monkeypatch, truth.T_camera_lidar)
    data = sample.select("0:5")
    result = calibgraph.calibrate(data, matcher=CmrNextMatcher([far_weights, far_weights]))
    assert result.correspondences is not None
    require_near(result.rig, truth, deg=0.02, cm=0.4)
    assert all(check.status == "PASS" for check in result.verdict.checks)
    alone = calibgraph.solve(data.rig, result.correspondences)
    check_true_poses(alone, result.correspondences, data)


@pytest.mark.slow
def test_a_network_that_has_memorised_its_rig_fails(
    sample: Dataset, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its poses are right, and would be the same on any other car."""
    truth = load_rig(SAMPLE / "reference.yaml")
    matcher = CmrNextMatcher([weights])
    replace_networks(monkeypatch, truth.T_camera_lidar, memorised=True)
    result = calibgraph.calibrate(sample.select("0:5"), truth, matcher=matcher)
    assert result.verdict.status == "FAIL"
    probability, *reasons = result.verdict.reasons
    assert probability.startswith("off by more than")
    assert all("even without the image" in reason for reason in reasons)


@pytest.mark.slow
def test_frames_beyond_the_range_of_training_are_dropped(
    sample: Dataset, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Corrections of 10 deg by a network trained for 1 are left out, unless all frames are so."""
    truth = load_rig(SAMPLE / "reference.yaml")
    far = {name: np.array(T) for name, T in truth.T_camera_lidar.items()}
    far["left"][:3, :3] = Rotation.from_rotvec([0.0, 0.2, 0.0]).as_matrix() @ far["left"][:3, :3]
    matcher = CmrNextMatcher([weights])
    replace_networks(monkeypatch, far)
    result = calibgraph.calibrate(sample.select("0:2"), truth, matcher=matcher)
    failed = result.correspondences.metadata["failed_frames"]  # type: ignore[union-attr]
    assert failed["front_left"] == [] and len(failed["left"]) == 2
    assert result.camera_verdicts["left"].status == "FAIL"
    assert any("100% of the frames failed" in r for r in result.camera_verdicts["left"].reasons)
