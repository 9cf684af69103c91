"""The paper's own numbers, its tables 2 to 4: single runs, without intervals."""

from __future__ import annotations

from benchmarks.paper.methods import STAGE1, TRF_TERMS

AXES = (
    "translation_error_cm", "rotation_error_deg", "x_cm", "y_cm", "z_cm",
    "roll_deg", "pitch_deg", "yaw_deg",
)  # fmt: skip
PAIR = "pair"
_REPROJECTION, _PRIORS, _FULL = TRF_TERMS

_CAMERAS: dict[tuple[str, str, int], tuple[tuple[float, ...], tuple[float, ...]]] = {
    ("kitti", STAGE1, 10): (
        (1.14, 0.002, 1.12, 0.07, 0.22, 0.01, 0.04, 0.10),
        (5.99, 0.001, 5.84, 0.97, 0.95, 0.04, 0.02, 0.01),
    ),
    ("kitti", _FULL, 10): (
        (1.19, 0.043, 1.06, 0.53, 0.11, 0.02, 0.02, 0.03),
        (5.17, 0.030, 5.12, 0.57, 0.51, 0.03, 0.00, 0.01),
    ),
    ("kitti", STAGE1, 100): (
        (2.63, 0.187, 2.58, 0.46, 0.21, 0.04, 0.09, 0.08),
        (6.23, 0.137, 6.13, 0.78, 0.76, 0.04, 0.03, 0.02),
    ),
    ("kitti", _FULL, 100): (
        (0.89, 0.038, 0.77, 0.34, 0.20, 0.01, 0.01, 0.03),
        (4.97, 0.030, 4.88, 0.67, 0.71, 0.01, 0.01, 0.01),
    ),
    ("walkley", STAGE1, 10): (
        (150.9, 0.91, 51.0, 0.97, 142.0, 0.21, 0.51, 0.74),
        (41.6, 0.63, 24.9, 22.2, 24.8, 0.32, 0.28, 0.49),
    ),
    ("walkley", _REPROJECTION, 10): (
        (60.2, 1.06, 10.5, 30.7, 50.7, 0.46, 0.39, 0.87),
        (24.3, 0.50, 1.23, 24.0, 3.76, 0.35, 0.06, 0.35),
    ),
    ("walkley", _PRIORS, 10): (
        (133.7, 0.80, 45.7, 0.83, 125.6, 0.18, 0.44, 0.64),
        (35.5, 0.56, 21.4, 19.9, 21.3, 0.28, 0.25, 0.43),
    ),
    ("walkley", _FULL, 10): (
        (54.2, 0.95, 9.50, 27.6, 45.7, 0.41, 0.35, 0.78),
        (21.9, 0.45, 1.10, 21.6, 3.37, 0.32, 0.06, 0.31),
    ),
    ("walkley", STAGE1, 100): (
        (87.2, 1.09, 24.8, 13.2, 82.5, 0.35, 0.48, 0.89),
        (108.6, 1.66, 2.46, 27.9, 104.9, 0.64, 0.09, 1.54),
    ),
    ("walkley", _REPROJECTION, 100): (
        (25.7, 0.825, 13.8, 16.8, 13.8, 0.27, 0.32, 0.71),
        (3.57, 0.230, 2.31, 0.31, 2.70, 0.07, 0.05, 0.21),
    ),
    ("walkley", _PRIORS, 100): (
        (75.6, 0.9, 22.2, 15.3, 71.7, 0.31, 0.41, 0.79),
        (93.2, 1.5, 2.2, 23.9, 93.7, 0.57, 0.08, 1.3),
    ),
    ("walkley", _FULL, 100): (
        (22.6, 0.726, 12.1, 14.8, 12.1, 0.24, 0.29, 0.62),
        (3.14, 0.203, 2.03, 0.27, 2.38, 0.06, 0.04, 0.19),
    ),
}
"""Per data, row and N: primary and secondary camera, in the order of AXES."""

_PAIRS: dict[tuple[str, str, int], tuple[float, float]] = {
    ("kitti", STAGE1, 10): (5.04, 0.001),
    ("kitti", _REPROJECTION, 10): (4.37, 0.035),
    ("kitti", _PRIORS, 10): (4.18, 0.178),
    ("kitti", _FULL, 10): (4.11, 0.033),
    ("kitti", STAGE1, 100): (3.56, 0.206),
    ("kitti", _REPROJECTION, 100): (4.46, 0.040),
    ("kitti", _PRIORS, 100): (4.18, 0.178),
    ("kitti", _FULL, 100): (4.16, 0.037),
    ("walkley", STAGE1, 10): (117.1, 1.08),
    ("walkley", _REPROJECTION, 10): (47.8, 1.06),
    ("walkley", _PRIORS, 10): (100.9, 1.06),
    ("walkley", _FULL, 10): (43.1, 0.95),
    ("walkley", STAGE1, 100): (87.0, 1.06),
    ("walkley", _REPROJECTION, 100): (23.9, 0.914),
    ("walkley", _PRIORS, 100): (76.5, 0.9),
    ("walkley", _FULL, 100): (21.0, 0.804),
}
"""Between the cameras: translation [cm] and rotation [deg]."""

_PIXELS: dict[tuple[str, str, int], tuple[float, float]] = {
    ("kitti", STAGE1, 10): (1.09, 0.52),
    ("kitti", _REPROJECTION, 10): (0.72, 0.43),
    ("kitti", _PRIORS, 10): (2.19, 0.56),
    ("kitti", _FULL, 10): (0.67, 0.41),
    ("kitti", STAGE1, 100): (2.57, 0.65),
    ("kitti", _REPROJECTION, 100): (0.77, 0.54),
    ("kitti", _PRIORS, 100): (2.19, 0.56),
    ("kitti", _FULL, 100): (0.71, 0.50),
}
"""Median reprojection errors of both cameras [px]; the paper has none for Walkley."""


def published(data: str, row: str, frames: int, camera: int | str) -> dict[str, float]:
    """The paper's numbers by metric; empty where it has none.

    Args:
        data: ``kitti`` or ``walkley``.
        row: of the experiment: Stage 1, or a row of the paper's solver.
        frames: N.
        camera: position of the camera in the rig, or PAIR.
    """
    key = (data, row, frames)
    if camera == PAIR:
        return dict(zip(AXES, _PAIRS.get(key, ()), strict=False))
    if key not in _CAMERAS and key not in _PIXELS:
        return {}
    if not isinstance(camera, int) or camera > 1:
        return {}
    metrics = dict(zip(AXES, _CAMERAS[key][camera], strict=True)) if key in _CAMERAS else {}
    if key in _PIXELS:
        metrics["reprojection_px"] = _PIXELS[key][camera]
    return metrics
