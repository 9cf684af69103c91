"""Results as plain values, for programs: ``--json``."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from calibgraph.model.calibration import Calibration
from calibgraph.model.verdict import Verdict


def result_summary(result: Calibration, written: list[Path]) -> dict[str, Any]:
    """A result as plain values; every key names its unit."""
    cameras = {}
    for name, T in result.T_camera_lidar.items():
        cameras[name] = {
            "T_camera_lidar": T.tolist(),
            **verdict_summary(result.camera_verdicts[name]),
            "actions": list(result.summary_of(name).actions),
            **_sigmas(result, name),
            "residuals": _values(result.residuals.get(name)),
            "weaknesses": list(result.weaknesses.get(name, ())),
            "error_sources": _values(result.error_sources.get(name)),
            "counts": result.counts[name],
            "lens": [
                {**vars(one), "is_determined": one.is_determined}
                for one in result.lens.get(name, ())
            ],
            "lens_covariance": (
                result.joint_of_lens(name) if name in result.lens_covariance else None
            ),
        }
    lidars = {
        name: {
            "T_base_lidar": result.T_base_lidar[name].tolist(),
            **verdict_summary(verdict),
            **_sigmas(result, name),
        }
        for name, verdict in result.lidar_verdicts.items()
    }
    return {
        **verdict_summary(result.verdict),
        "summary": asdict(result.summary),
        "warnings": list(result.warnings),
        "places": [list(place) for place in result.places],
        "cameras": cameras,
        "lidars": lidars,
        "pairs": {name: _sigmas(result, name) for name in result.pair_covariance},
        "timings_s": result.timings_s,
        "files": [str(path) for path in written],
    }


def verdict_summary(verdict: Verdict) -> dict[str, Any]:
    """A verdict as plain values."""
    doubt = verdict.error_probability
    return {
        "verdict": verdict.status,
        "cannot_tell": verdict.cannot_tell,
        "probability_off": None if doubt is None else doubt.probability,
        "reasons": list(verdict.reasons),
    }


def _values(of: object | None) -> dict[str, Any] | None:
    return None if of is None else vars(of)


def _sigmas(result: Calibration, name: str) -> dict[str, list[float] | bool | None]:
    """Standard deviations of a camera or a pair, about and along x, y, z, and if they hold."""
    sigmas = result.sigmas(name)
    return {
        "error_bar_holds": result.error_bar_holds(name),
        "rotation_sigma_deg": None if sigmas is None else sigmas[0].tolist(),
        "translation_sigma_cm": None if sigmas is None else sigmas[1].tolist(),
    }
