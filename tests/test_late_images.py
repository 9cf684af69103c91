"""Images that are taken later than their clouds, from images and clouds to the result."""

from __future__ import annotations

import numpy as np
import pytest

from calibgraph import (
    Config,
    Dataset,
    Rig,
    calibrate,
    dataset_from_arrays,
    evaluate,
    load_dataset,
    load_rig,
    perturb,
)
from calibgraph.matching.structure import StructureMatcher
from factors import Clock, displace
from tests.conftest import SAMPLE
from tests.draws.clocks import draw_twists

CAMERA = "front_left"
OFFSET_S, READOUT_S = 0.03, 0.02


def truth() -> Rig:
    return Rig(cameras={CAMERA: load_rig(SAMPLE / "reference.yaml").cameras[CAMERA]})


def late_sample() -> Dataset:
    """The sample with clouds of a LiDAR that moves, as it saw them before the rows were taken."""
    data, rig = load_dataset(SAMPLE, truth()), truth()
    camera, twists = rig.cameras[CAMERA], draw_twists(len(data.frames), np.random.default_rng(3))
    clock, T = Clock(OFFSET_S, READOUT_S, camera.height_px), camera.T_camera_lidar
    clouds, images = [], []
    for frame, twist in zip(data.frames, twists, strict=True):
        cloud = frame.load_cloud().astype(np.float64)
        pixels, _ = camera.lens.project(cloud[:, :3] @ T[:3, :3].T + T[:3, 3])
        rows_px = np.clip(np.nan_to_num(pixels[:, 1]), 0, camera.height_px - 1)
        before = displace(cloud[:, :3], twist, clock.times_s(rows_px))
        clouds.append(np.column_stack([before, cloud[:, 3]]))
        images.append(frame.load_image(CAMERA, camera))
    return dataset_from_arrays(rig, clouds, {CAMERA: images}, twists_per_s=twists)


def test_offset_and_readout_are_found_with_the_pose() -> None:
    data, rig = late_sample(), truth()
    start = perturb(rig, rotation_deg=1.0, translation_m=0.1, seed=0)
    matcher = StructureMatcher(search_deg=None, search_m=None)
    result = calibrate(data, start, matcher, Config(estimate="clock"))
    offset, readout = result.lens[CAMERA]
    assert abs(offset.value - OFFSET_S) < 4 * offset.sigma < 0.012
    assert abs(readout.value - READOUT_S) < 4 * readout.sigma < 0.04
    error = evaluate(result.rig, rig).cameras[CAMERA]
    assert error.translation_error_cm < 3.0  # with a fixed clock 11
    assert error.rotation_error_deg < 0.2


@pytest.mark.slow
def test_a_fixed_clock_is_no_pass_and_names_the_offset() -> None:
    data, rig = late_sample(), truth()
    matcher = StructureMatcher(search_deg=None, search_m=None)
    result = calibrate(data, rig, matcher)
    verdict = result.camera_verdicts[CAMERA]
    assert verdict.status != "PASS"
    (check,) = (c for c in verdict.checks if c.kind == "time_offset")
    assert check.status != "PASS"
    assert "ms later" in check.text and "--estimate offset" in check.text
    known = rig.cameras[CAMERA].model_copy(
        update={"time_offset_s": OFFSET_S, "readout_s": READOUT_S}
    )
    right = calibrate(data, Rig(cameras={CAMERA: known}))  # its search knows the clock, too
    assert evaluate(right.rig, rig).cameras[CAMERA].translation_error_cm < 5.0
    (check,) = (c for c in right.camera_verdicts[CAMERA].checks if c.kind == "time_offset")
    assert check.status == "PASS"
