"""Joint multi-camera LiDAR extrinsic calibration as a factor graph.

``T_a_b`` maps coordinates in b to coordinates in a: ``p_camera = T_camera_lidar * p_lidar``.
Names are imported when first used, so that importing this package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOMES = {
    "calibgraph.pipeline": ("Matcher", "calibrate"),
    "calibgraph.calibration": ("Calibration", "Residuals", "load_calibration"),
    "calibgraph.check": ("Check", "Verdict"),
    "calibgraph.config": ("Config", "load_config", "preset"),
    "calibgraph.correspondence_file": ("load_correspondences",),
    "calibgraph.correspondences": ("Correspondences", "concatenate"),
    "calibgraph.dataset": ("Dataset", "Frame", "load_dataset"),
    "calibgraph.errors": (
        "CalibrationError",
        "CorrespondenceError",
        "DatasetError",
        "FileError",
        "RigError",
    ),
    "calibgraph.metrics": ("Evaluation", "PoseError", "evaluate"),
    "calibgraph.load": ("load_rig",),
    "calibgraph.perturbation": ("perturb",),
    "calibgraph.rig": ("Camera", "Intrinsics", "RelativePose", "Rig"),
    "calibgraph.simulation.correspondences": ("MatcherErrors", "simulate_correspondences"),
    "calibgraph.simulation.recording": ("simulate_street",),
    "calibgraph.two_pass": ("solve",),
    "calibgraph.structure": ("StructureMatcher",),
    "calibgraph.tracking": ("DurableCalibrator", "Event", "IncrementalCalibrator", "Update"),
    "factors": (
        "block_factor",
        "camera_prior_factor",
        "projection_factor",
        "relative_pose_factor",
        "relative_prior_factor",
    ),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = list(_HOME_OF)  # noqa: PLE0605 - from the one list above


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'calibgraph' has no attribute {name!r}")
    return getattr(import_module(_HOME_OF[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
