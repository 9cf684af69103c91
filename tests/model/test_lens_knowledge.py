"""How well lenses are known: stated where a rig is written, else said in the result."""

from __future__ import annotations

import pytest

from calibgraph import Rig
from calibgraph.graph.lens import LensVariable
from calibgraph.model.lens_knowledge import (
    IN_DOUBT,
    LensSigmas,
    state_calibrated,
)
from tests.conftest import make_pair


def test_a_calibrated_lens_is_known_to_a_500th_of_its_focal_length() -> None:
    rig = state_calibrated(make_pair())
    for camera in rig.cameras.values():
        sigma, fx = camera.intrinsics_sigma_px, camera.intrinsics_px.fx
        assert sigma is not None
        assert sigma.focal == pytest.approx(0.002 * fx, abs=0.006)  # written to 0.01 px
        assert sigma.centre == pytest.approx(0.002 * fx, abs=0.006)
        assert camera.distortion_sigma == 0.002
    doubted = {n: IN_DOUBT.state_in(c) for n, c in make_pair().cameras.items()}
    again = state_calibrated(Rig(cameras=doubted))
    for name, camera in again.cameras.items():
        assert camera.intrinsics_sigma_px == doubted[name].intrinsics_sigma_px


def test_a_lens_without_a_word_has_the_priors_of_a_stated_calibration() -> None:
    (camera, *_) = make_pair().cameras.values()
    (stated, *_) = state_calibrated(make_pair()).cameras.values()
    parts = ("focal", "centre", "distortion")
    without, with_sigmas = (
        LensVariable.of(each, parts, LensSigmas.calibrated(camera)).free.sigmas
        for each in (camera, stated)
    )
    assert with_sigmas == pytest.approx(without, rel=0.01)  # written to 0.01 px
