"""One JSON line per update, for programs in any language."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from calibgraph.model.summary import summarize
from calibgraph.report.as_json import finite
from calibgraph.tracking.events import Event
from calibgraph.tracking.update import Update


def json_line(update: Update) -> str:
    """The update as one line of JSON; units are in the keys, matrices row by row."""
    cameras = {name: _camera(update, name) for name in update.T_camera_lidar}
    content = {
        "frame": update.frame,
        "stamp_ns": update.stamp_ns,
        "cameras": cameras,
        "events": [_event(event) for event in update.events],
    }
    return json.dumps(finite(content), allow_nan=False)


def _camera(update: Update, name: str) -> dict[str, Any]:
    covariance, verdict = update.covariance[name], update.verdicts[name]
    sigmas = None if covariance is None else np.sqrt(np.diag(covariance))
    return {
        "T_camera_lidar": update.T_camera_lidar[name].tolist(),
        "covariance": None if covariance is None else covariance.tolist(),
        "rotation_sigma_deg": None if sigmas is None else np.degrees(sigmas[:3]).tolist(),
        "translation_sigma_cm": None if sigmas is None else (100 * sigmas[3:]).tolist(),
        "verdict": verdict.status,
        "cannot_tell": verdict.cannot_tell,
        "reasons": list(verdict.reasons),
        "actions": list(summarize({name: verdict}).actions),
        "used": update.used.get(name, 0),
        "left_out": name in update.left_out,
    }


def _event(event: Event) -> dict[str, Any]:
    size = {} if event.size is None else vars(event.size)
    return {**vars(event), "size": size or None, "text": str(event)}
