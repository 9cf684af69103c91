"""Simulated recordings: datasets with their truth; the sample is one of them."""

import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest

from calibgraph import CalibrationError, Rig, load_dataset, load_rig
from calibgraph.model.geometry import angle_deg, relative_transform
from calibgraph.simulation.lidar import scan
from calibgraph.simulation.recording import build_drive, simulate_street
from tests.conftest import ROOT, SAMPLE, Call
from tests.simulation.conftest import SCAN
from tools.scenes.surroundings import SURROUNDINGS

pytestmark = pytest.mark.usefixtures("open3d")


@pytest.mark.parametrize(
    ("surroundings", "vary_layout"),
    [
        ("street", True),
        pytest.param("street", False, marks=pytest.mark.slow),
        *(pytest.param(name, True, marks=pytest.mark.slow) for name in [*SURROUNDINGS][1:]),
    ],
)  # fmt: skip
def test_stops_are_apart_and_the_lane_is_free(surroundings: str, vary_layout: bool) -> None:
    scene = SURROUNDINGS[surroundings]
    drive = build_drive(frames=6, step_m=5.0, seed=2, vary_layout=vary_layout, build_scene=scene)
    places = np.array([T[:3, 3] for T in drive.T_world_lidar])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    # Along the line 5 m +- 15 %; across, each stop sways by 0.25 m, which adds under 5 %.
    assert steps.min() > 0.8 * 5.0
    assert steps.max() < 1.25 * 5.0
    for T in drive.T_world_lidar:
        cloud = scan(drive.world, SCAN, np.ones(16), T, rng=np.random.default_rng(0))
        x, y, z = cloud[:, :3].T
        assert not np.any((np.abs(x) < 2.5) & (np.abs(y) < 1.0) & (z > -1.4))


def test_a_recording_is_a_dataset_with_its_truth(recording: Path, rig: Rig) -> None:
    data, truth = load_dataset(recording), load_rig(recording / "reference.yaml")
    assert [frame.name for frame in data.frames] == ["000000", "000001"]
    for name, camera in truth.cameras.items():
        assert np.allclose(camera.T_camera_lidar, rig.cameras[name].T_camera_lidar, atol=1e-12)
        off = relative_transform(data.rig.cameras[name].T_camera_lidar, camera.T_camera_lidar)
        assert angle_deg(off[:3, :3]) == pytest.approx(3.0)
        image = data.frames[1].load_image(name, camera)
        assert image.std() > 20  # levels: there is something to see
    cloud = data.frames[1].load_cloud()
    assert cloud.shape[1] == 4
    assert 0.5 * 16 * 1800 < len(cloud) < 16 * 1800
    assert cloud[:, 3].min() >= 0
    assert cloud[:, 3].max() <= 1


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"beams": 33}, "33 beams"),
        ({"frames": 0}, "0 frames"),
        ({"step_m": -1.0}, "-1.0 m apart"),
        ({"step_m": float("nan")}, "nan m apart"),
        ({"frames": 1000}, "1000 frames, 4.0 m apart"),
        ({"rotation_deg": -1.0}, "-1.0 deg"),
    ],
)
def test_bad_arguments_are_refused(
    rig: Rig, tmp_path: Path, changed: dict[str, float], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        simulate_street(tmp_path / "out", rig, **changed)
    assert not (tmp_path / "out").exists()


def test_missing_open3d_says_how_to_install_it(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(CalibrationError, match=r"pip install 'calibgraph\[simulation\]'"):
        simulate_street(tmp_path / "out", rig, frames=1)


@pytest.mark.ci
@pytest.mark.slow
def test_the_command_in_the_readme_makes_the_sample(call: Call, tmp_path: Path) -> None:
    line = re.search(r"^    calibgraph (.*) --out data/sample$", README, flags=re.MULTILINE)
    assert line is not None
    code, _, errors = call(*shlex.split(line[1]), "--out", tmp_path / "sample")
    assert code == 0, errors
    for file in ("rig.yaml", "reference.yaml"):
        made, kept = load_rig(tmp_path / "sample" / file), load_rig(SAMPLE / file)
        assert list(made.cameras) == list(kept.cameras)
        for name, camera in made.cameras.items():
            assert camera.intrinsics_px == kept.cameras[name].intrinsics_px
            assert camera.distortion == kept.cameras[name].distortion
            T = kept.cameras[name].T_camera_lidar
            np.testing.assert_allclose(camera.T_camera_lidar, T, atol=1e-12)
    made, kept = load_dataset(tmp_path / "sample"), load_dataset(SAMPLE)
    assert len(made.frames) == len(kept.frames) == 6
    for new, old in zip(made.frames, kept.frames, strict=True):
        # The ray caster is float32 to 80 m: 1e-5 m; another processor may round otherwise, and
        # where the paint has an edge, a point that moved so far has another intensity: up to 14
        # of 12,315 on one processor. Of another seed nearly all have.
        clouds = [frame.load_cloud() for frame in (new, old)]
        np.testing.assert_allclose(clouds[0][:, :3], clouds[1][:, :3], atol=1e-4)
        assert np.mean(np.abs(clouds[0][:, 3] - clouds[1][:, 3]) > 1e-4) < 5e-3
        for name, camera in kept.rig.cameras.items():
            levels = [frame.load_image(name, camera).astype(int) for frame in (new, old)]
            assert (
                np.abs(levels[0] - levels[1]).mean() < 0.1
            )  # JPEG libraries may differ by a level


README = (ROOT / "data" / "README.md").read_text()
