"""The result of one frame: estimates, covariances, verdicts, events."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.geometry import to_T_camera_lidar
from calibgraph.model.summary import summarize
from calibgraph.model.verdict import Verdict
from calibgraph.report.as_json import finite
from calibgraph.tracking.assessment import Assessment, covariance_by_camera
from calibgraph.tracking.events import Event
from calibgraph.tracking.frame_order import Incoming
from calibgraph.tracking.state import State


@dataclass(frozen=True, eq=False)
class Update:
    """The estimates after a frame.

    Frames that are taken in at once share their arrays, which are read-only.

    Attributes:
        frame: its number.
        stamp_ns: its time, or that of the last frame that had one, or None.
        T_camera_lidar: per camera, (4, 4): p_camera = T_camera_lidar * p_lidar. The guess, as long
            as the camera has no estimate.
        covariance: per camera, (6, 6) of xi in T_camera_lidar = exp(xi) estimate, xi = (rotation
            [rad], translation [m]) in the camera's axes; None until the camera has enough frames.
        verdicts: per camera, whether its estimate can be used now, with reasons.
        events: the events detected with this frame.
        used: per camera whose matches were absorbed, how many.
        left_out: cameras whose matches disagree with the estimate, and were not absorbed.
    """

    frame: int
    stamp_ns: int | None
    T_camera_lidar: dict[str, Array]
    covariance: dict[str, Array | None]
    verdicts: dict[str, Verdict]
    events: tuple[Event, ...]
    used: dict[str, int]
    left_out: tuple[str, ...]


def make_updates(
    state: State,
    assessment: Assessment,
    taken: Sequence[tuple[Incoming, Sequence[Event], Mapping[int, int]]],
) -> list[Update]:
    """The updates after the last frames of a state.

    Args:
        state: after the frames.
        assessment: of its estimates.
        taken: the frames that were taken in at once; the events detected with each, and per camera,
            by its place in the rig, how many of its matches were absorbed.
    """
    names = state.names
    poses = dict(zip(names, map(to_T_camera_lidar, assessment.T_lidar_camera), strict=True))
    covariance = covariance_by_camera(assessment, names)
    for array in (*poses.values(), *covariance.values()):
        if array is not None:
            array.setflags(write=False)  # the updates share them
    last = {n: one.agreements[-1:] for n, one in zip(names, state.cameras, strict=True)}
    return [
        Update(
            frame=one.number,
            stamp_ns=one.stamp_ns,
            T_camera_lidar=dict(poses),
            covariance=dict(covariance),
            verdicts=dict(assessment.verdicts),
            events=tuple(events),
            used={names[camera]: count for camera, count in used.items()},
            left_out=tuple(n for n in names if last[n] == ((one.number, False),)),
        )
        for one, events, used in taken
    ]


def shared_parts(update: Update) -> tuple[int, ...]:
    """Identities of what frames that are taken in at once share."""
    parts = update.T_camera_lidar, update.covariance, update.verdicts
    return tuple(id(value) for part in parts for value in part.values())


def json_lines(updates: Sequence[Update]) -> list[str]:
    """A line of JSON of each update; units are in the keys, matrices row by row.

    What frames that were taken in at once share is encoded once.
    """
    estimates: dict[tuple[int, ...], dict[str, str]] = {}
    lines = []
    for update in updates:
        if (shared := shared_parts(update)) not in estimates:
            estimates[shared] = {name: _estimate(update, name) for name in update.T_camera_lidar}
        cameras = ", ".join(
            f"{text}, {_of_frame(update, name)}}}" for name, text in estimates[shared].items()
        )
        stamp = "null" if update.stamp_ns is None else update.stamp_ns
        head = f'"frame": {update.frame}, "stamp_ns": {stamp}'
        events = _json([*map(_event, update.events)]) if update.events else "[]"
        lines.append(f'{{{head}, "cameras": {{{cameras}}}, "events": {events}}}')
    return lines


def _json(content: Any) -> str:
    try:
        return json.dumps(content, allow_nan=False)
    except ValueError:  # of numbers that JSON does not have
        return json.dumps(finite(content), allow_nan=False)


def _estimate(update: Update, name: str) -> str:
    """A camera's name, and the first members of its object: those that hold for all frames."""
    covariance, verdict = update.covariance[name], update.verdicts[name]
    sigmas = None if covariance is None else np.sqrt(np.diag(covariance))
    content = {
        "T_camera_lidar": update.T_camera_lidar[name].tolist(),
        "covariance": None if covariance is None else covariance.tolist(),
        "rotation_sigma_deg": None if sigmas is None else np.degrees(sigmas[:3]).tolist(),
        "translation_sigma_cm": None if sigmas is None else (100 * sigmas[3:]).tolist(),
        "verdict": verdict.status,
        "cannot_tell": verdict.cannot_tell,
        "reasons": list(verdict.reasons),
        "actions": list(summarize({name: verdict}).actions),
    }
    return f"{_json(name)}: {_json(content)[:-1]}"


def _of_frame(update: Update, name: str) -> str:
    """The other members."""
    return f'"used": {update.used.get(name, 0)}, "left_out": {str(name in update.left_out).lower()}'


def _event(event: Event) -> dict[str, Any]:
    size = {} if event.size is None else vars(event.size)
    return {**vars(event), "size": size or None, "text": str(event)}
