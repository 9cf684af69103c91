"""Weights of windows, trained on the pose at the optimum of the graph."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from calibgraph import Correspondences, Dataset, DatasetError  # noqa: E402
from calibgraph.io.frame import Frame  # noqa: E402
from calibgraph.matching.structure.frame_cache import FrameCache  # noqa: E402
from calibgraph.matching.structure.peaks import find_local_peaks  # noqa: E402
from calibgraph.matching.structure.shift_scores import score_frame  # noqa: E402
from calibgraph.matching.structure.training import (  # noqa: E402
    WindowSettings,
    loss,
    train_windows,
)
from calibgraph.matching.structure.training.samples import (  # noqa: E402
    LEVEL,
    NEAR,
    SIDE,
    CameraWindows,
    camera_windows,
)
from calibgraph.matching.structure.training.train import _standard_error  # noqa: E402
from calibgraph.matching.structure.window_weights import window_network  # noqa: E402
from calibgraph.matching.trusted_data import load_trusted_dataset  # noqa: E402
from calibgraph.model.clock import at_pixels  # noqa: E402
from calibgraph.solver.camera_twist import project_with_jacobian  # noqa: E402
from tests.conftest import SAMPLE  # noqa: E402

SMALL = WindowSettings(frames=3, windows=1500, epochs=15, batch=3, noise=0.0)


@pytest.fixture(scope="module")
def trusted() -> Dataset:
    return load_trusted_dataset(SAMPLE)


@pytest.fixture(scope="module")
def sample(trusted: Dataset) -> CameraWindows:
    name, camera = next(iter(trusted.rig.cameras.items()))
    found = camera_windows(trusted.frames[:2], name, camera, per_frame=800, cache=FrameCache())
    assert found is not None
    return found


def test_peaks_are_those_of_the_matcher() -> None:
    """Where both have one: the matcher's grids are larger, so that none is near a rim."""
    grids = np.random.default_rng(0).normal(size=(200, SIDE, SIDE)).astype(np.float32)
    wide = np.pad(grids, ((0, 0), (4, 4), (4, 4)))
    shift, hessian, peak = find_local_peaks(wide, np.zeros((200, 2)))
    found = [part.numpy() for part in loss._peaks(torch.as_tensor(grids))]
    inside = np.isfinite(peak)
    assert inside.sum() > 100
    # Single precision of curvatures of about 1, of which the least is a tenth of the largest.
    np.testing.assert_allclose(found[0][inside], shift[inside], atol=1e-3)
    np.testing.assert_allclose(found[1][inside], hessian[inside], atol=1e-3)
    np.testing.assert_array_equal(found[2][inside], peak[inside].astype(np.float32))
    assert (found[1][~inside] == 0).all() and NEAR > 2


def test_the_gradient_is_that_of_solving_again(
    sample: CameraWindows, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the directions and the spread as they are, which the gradient leaves out."""
    known: dict[str, object] = {}
    for name in ("_directions", "_spread"):
        true = getattr(loss, name)
        monkeypatch.setattr(loss, name, lambda *a, n=name, f=true: known.setdefault(n, f(*a)))
    features = torch.as_tensor(sample.features[:, :3]).double()
    along = 0.1 * (features - features.mean(0)) / features.std(0)

    def value(by: torch.Tensor) -> torch.Tensor:
        found = loss.pose_negative_log_likelihood(torch.sigmoid(along @ by).float(), sample)
        assert found is not None
        return found

    by = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    value(by).backward()
    assert by.grad is not None and by.grad.abs().max() > 0.05
    for axis, step in enumerate(0.02 * torch.eye(3, dtype=torch.float64)):
        with torch.no_grad():
            difference = float(value(step) - value(-step)) / 0.04
        # Scores are in single precision: 1e-6 of a value of some 30, over the step.
        assert difference == pytest.approx(float(by.grad[axis]), rel=0.02, abs=2e-3)


@pytest.mark.parametrize("clock", [(0.0, 0.0), (0.08, 0.0), (0.08, 0.03)])
def test_points_are_where_they_are_when_their_pixels_are_taken(
    trusted: Dataset, clock: tuple[float, float]
) -> None:
    """As those of the matcher's rows in a solve, with a late camera on a LiDAR that moves."""
    given, twist = trusted.frames[0], np.array([0.0, 0.02, 0.3, 8.0, 0.3, 0.0])
    name, camera = next(iter(trusted.rig.cameras.items()))
    camera = camera.model_copy(update={"time_offset_s": clock[0], "readout_s": clock[1]})
    files = given.index, given.name, given.cloud_path, given.image_paths
    frame, cache = Frame(*files, find_twist=lambda: twist), FrameCache()
    found = camera_windows([frame], name, camera, per_frame=800, cache=cache)
    scores = score_frame(
        cache.image(frame, name, camera), cache.cloud(frame), camera, LEVEL,
        frame=0, max_windows=800, twist_per_s=twist,
    )  # fmt: skip
    rows = Correspondences.from_arrays(
        camera=name, frame=scores.frame, pixels_px=scores.pixels_px,
        points_lidar_m=scores.points_lidar_m, twist_per_s=np.tile(twist, (len(scores.frame), 1)),
    )  # fmt: skip
    assert found is not None and len(rows) > 15
    np.testing.assert_allclose(found.pixels_px, scores.pixels_px, atol=1e-9)
    # A group is 3 degrees wide: its rows are taken within 4 ms, in which a mean is off by less.
    points = at_pixels(camera, rows).points_lidar_m
    np.testing.assert_allclose(found.points_lidar_m, points, atol=1e-9 if not clock[1] else 5e-3)
    pixels, _ = project_with_jacobian(camera, found.points_lidar_m)
    np.testing.assert_allclose(pixels, found.pixels_px, atol=1e-6)


def test_training_makes_the_poses_likelier_and_repeats(trusted: Dataset) -> None:
    data = trusted.select("0:4")
    found = train_windows([data], [trusted.select("4:6")], SMALL)
    assert found.loss[1] < found.loss[0] - 0.05
    assert np.isfinite(found.held_out).all()
    again = train_windows([data], [trusted.select("4:6")], SMALL)
    assert again.loss == found.loss
    for (a, _), (b, _) in zip(again.network.layers, found.network.layers, strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.allclose(found.network.layers[0][0], window_network().layers[0][0])


def test_recordings_without_matches_are_refused(trusted: Dataset, tmp_path: Path) -> None:
    turned = {name: np.diag([1.0, -1, -1, 1]) @ T for name, T in trusted.rig.T_camera_lidar.items()}
    away = Dataset(trusted.rig.moved_to(turned), trusted.frames[:1], (tmp_path,))
    with pytest.raises(DatasetError, match="no camera has enough windows"):
        train_windows([away], settings=SMALL)


def test_the_standard_error_is_unknown_of_one_camera_or_a_lost_one() -> None:
    assert _standard_error(np.array([1.0, 2.0, 3.0])) == pytest.approx(1 / np.sqrt(3))
    for changes in ([], [1.0], [1.0, np.inf]):
        assert np.isnan(_standard_error(np.array(changes)))
