"""Simulated tables, and the checks of a result by words."""

from __future__ import annotations

from calibgraph import (
    Calibration,
    Check,
    Correspondences,
    MatcherErrors,
    Rig,
    simulate_correspondences,
)

ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=0.5, outlier_share=0.1)


def simulated(rig: Rig, **settings: object) -> Correspondences:
    return simulate_correspondences(
        rig, **{"frames": 12, "matches": 150, "errors": ERRORS, **settings}
    )


def named(result: Calibration, camera: str, words: str) -> list[Check]:
    return [c for c in result.camera_verdicts[camera].checks if words in f"{c.name} {c.text}"]
