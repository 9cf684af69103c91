"""Simulated tables, a camera of the sample, and the checks of a result by words."""

from __future__ import annotations

import pytest

from calibgraph import (
    Calibration,
    Check,
    Correspondences,
    Dataset,
    MatcherErrors,
    Rig,
    load_dataset,
    load_rig,
    simulate_correspondences,
)
from tests.conftest import SAMPLE

ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=0.5, outlier_share=0.1)


def simulated(rig: Rig, **settings: object) -> Correspondences:
    return simulate_correspondences(
        rig, **{"frames": 12, "matches": 150, "errors": ERRORS, **settings}
    )


def named(result: Calibration, camera: str, words: str) -> list[Check]:
    return [c for c in result.camera_verdicts[camera].checks if words in f"{c.name} {c.text}"]


@pytest.fixture(scope="session")
def truth() -> Rig:
    """One camera of the sample at its true pose."""
    whole = load_rig(SAMPLE / "reference.yaml")
    return Rig(cameras={"front_left": whole.cameras["front_left"]})


@pytest.fixture(scope="session")
def dataset(truth: Rig) -> Dataset:
    """The sample, for this camera."""
    return load_dataset(SAMPLE, truth)
