"""The sample recording is what the command in data/README.md makes."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from calibgraph import load_dataset, load_rig
from tests.conftest import ROOT, SAMPLE, Call

pytestmark = pytest.mark.usefixtures("open3d")


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
        # where the paint has an edge, a point that moved so far has another intensity.
        clouds = [frame.load_cloud() for frame in (new, old)]
        np.testing.assert_allclose(clouds[0][:, :3], clouds[1][:, :3], atol=1e-4)
        assert np.mean(np.abs(clouds[0][:, 3] - clouds[1][:, 3]) > 1e-4) < 1e-3
        for name, camera in kept.rig.cameras.items():
            levels = [frame.load_image(name, camera).astype(int) for frame in (new, old)]
            assert (
                np.abs(levels[0] - levels[1]).mean() < 0.1
            )  # JPEG libraries may differ by a level


README = (ROOT / "data" / "README.md").read_text()
