"""Results as JSON on stdout, for programs: ``--json``."""

import json
import math
import os
import sys
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from calibgraph.errors import FileError
from calibgraph.model.calibration import Calibration
from calibgraph.model.verdict import Verdict


def result_summary(result: Calibration, written: list[Path]) -> dict[str, Any]:
    """A result as plain values; every key names its unit."""
    cameras = {}
    for name, T in result.T_camera_lidar.items():
        cameras[name] = {
            "T_camera_lidar": T.tolist(),
            **_of_verdict(result.camera_verdicts[name]),
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
            **_of_verdict(verdict),
            **_sigmas(result, name),
        }
        for name, verdict in result.lidar_verdicts.items()
    }
    return {
        **_of_verdict(result.verdict),
        "summary": asdict(result.summary),
        "warnings": list(result.warnings),
        "places": [list(place) for place in result.places],
        "cameras": cameras,
        "lidars": lidars,
        "pairs": {name: _sigmas(result, name) for name in result.pair_covariance},
        "timings_s": result.timings_s,
        "files": [str(path) for path in written],
    }


def _of_verdict(verdict: Verdict) -> dict[str, Any]:
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


def print_json(content: dict[str, Any]) -> None:
    """Print one JSON document on stdout; a reader that has gone is no error."""
    with suppress(BrokenPipeError):
        print_line(json.dumps(finite(content), indent=2, allow_nan=False))


def print_line(text: str) -> None:
    """Print a line on stdout at once.

    Raises:
        BrokenPipeError: if the reader has closed the pipe.
        FileError: if it cannot be written.
    """
    try:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()
    except OSError as error:
        discard_stdout()
        if isinstance(error, BrokenPipeError):
            raise
        what = f"cannot be written to ({error.strerror}); restart"
        raise FileError("standard output", what) from error


def require_stdout() -> None:
    """Check, before hours of work, that there is a standard output."""
    if sys.stdout is None:
        raise FileError("standard output", "is closed; give what is printed somewhere to go")


def discard_stdout() -> None:
    """Discard what else is written: Python would write it at its exit, and report the error."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def finite(value: Any) -> Any:
    """Replace NaN and infinity, which JSON does not have, by None, inside dicts and lists too."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
