"""Assessment of the present estimate: verdicts, updates of frames, the result as a calibration."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.calibration import Calibration
from calibgraph.model.geometry import invert, pair_covariances, pose_rows
from calibgraph.model.summary import summarize
from calibgraph.model.verdict import START, Check, Verdict
from calibgraph.stdout import finite
from calibgraph.tracking.estimate import Estimate
from calibgraph.tracking.events import Event
from calibgraph.tracking.frames import StreamFrame
from calibgraph.tracking.state import COUNTS, State
from calibgraph.trust.solution_checks import check_estimate
from calibgraph.trust.thresholds import threshold
from factors.pose_kernel import logarithms


class Verdicts(Mapping[str, Verdict]):
    """The verdict of each camera, made when it is read, from what it holds on to of the state.

    These are small parts, named as there, so that old updates need little memory.
    """

    def __init__(self, state: State, estimate: Estimate) -> None:
        self.names, self.config, self.findings = state.names, state.config, state.findings
        self.started, self.absent, self.walk = state.started, state.absent, state.walk
        self.agreements, self.refused = state.agreements, state.refused
        self.waiting = tuple(map(len, state.waiting))
        self.counts = state.counts
        self.covariance, self.frames = estimate.covariance, estimate.sums.frames
        self.conflicts = tuple(estimate.conflicts.values())
        self._known: dict[str, Verdict] = {}

    def __getitem__(self, name: str) -> Verdict:
        """The verdict of a camera."""
        if name not in self._known:
            self._known[name] = _verdict(self, self.names.index(name))
        return self._known[name]

    def __iter__(self) -> Iterator[str]:
        """The cameras' names."""
        return iter(self.names)

    def __len__(self) -> int:
        """How many cameras there are."""
        return len(self.names)


def _verdict(of: Verdicts, camera: int) -> Verdict:
    counts = dict(zip(COUNTS, of.counts[camera].tolist(), strict=True))
    limit, repeated = of.config.tracking.blind_frames, counts["repeated"]
    text = f"the last {repeated + 1} frames with matches have the same points"
    stuck = Check("stuck", "WARN", f"{text}: its stream is stuck, or sends them again")
    if not of.started[camera]:
        if repeated >= limit:
            return Verdict((replace(stuck, status="FAIL"),))
        needed = of.config.tracking.start_frames
        waiting = (f"{of.waiting[camera]} of {needed} frames with matches",)
        reasons = (f"no estimate yet: {reason}" for reason in of.refused[camera] or waiting)
        return Verdict(tuple(Check(START, "WARN", reason) for reason in reasons))
    name, rows, absent = of.names[camera], pose_rows(camera), int(of.absent[camera])
    own = of.covariance[rows, rows]
    is_free = bool(np.isnan(own).any())
    estimated = check_estimate(
        used=counts["used"],
        frames=int(of.frames[camera]),
        covariance=None if is_free else own,
        is_free=is_free,
        conflicts=[one for one in of.conflicts if name in (one.pair.a, one.pair.b)],
        scatter_only=not of.findings.states_common_error,
        tolerance=of.config.tolerance,
    )
    checks = [*estimated]
    if repeated >= limit > absent - repeated:
        checks.append(stuck)
    elif absent >= limit:
        text = f"no usable matches in the last {absent} frames"
        checks.append(Check("blind frames", "WARN", text, absent))
    if of.walk[camera]:
        checks.append(Check("drift", "WARN", "drifts: the estimate follows, over fewer frames"))
    agreements = [good for _, good in of.agreements[camera]]
    if agreements:
        share = 1 - sum(agreements) / len(agreements)
        text = f"share of the last {len(agreements)} frames that disagree with the estimate"
        checks.append(threshold("disagreeing_frames").check(share, name=text))
    return Verdict(tuple(checks))


def covariance_by_camera(estimate: Estimate, names: tuple[str, ...]) -> dict[str, Array | None]:
    """Per camera (6, 6); None with too few frames."""
    known = ~np.isnan(np.diagonal(estimate.covariance)[::6])
    return {
        name: estimate.covariance[6 * c : 6 * c + 6, 6 * c : 6 * c + 6] if known[c] else None
        for c, name in enumerate(names)
    }


def _counts(state: State, camera: int) -> dict[str, int]:
    """Correspondences and frames, by what became of them."""
    counts = dict(zip(COUNTS, state.counts[camera].tolist(), strict=True))
    used, waiting = counts.pop("absorbed"), len(state.waiting[camera])
    del counts["repeated"]
    frames = used + counts["left_out"] + waiting
    return {**counts, "frames": frames, "frames_used": used, "frames_waiting": waiting}


def to_calibration(state: State, estimate: Estimate) -> Calibration:
    """The present estimate as a result of the same type as a batch's."""
    joint = estimate.covariance
    known, second_moments = None if np.isnan(joint).any() else joint, None
    if known is not None:  # of the mounts about the estimates
        mounts, covariance = estimate.window.reported("mount")
        away = logarithms(estimate.T_camera_lidar @ invert(mounts)).ravel()
        second_moments = covariance + np.outer(away, away)
    rig, cameras = state.rig_at(estimate.T_camera_lidar), [*enumerate(state.names)]
    return Calibration(
        rig=rig,
        initial_rig=state.rig,
        covariance=covariance_by_camera(estimate, state.names),
        joint_covariance=known,
        pair_covariance=pair_covariances(second_moments, rig.T_camera_lidar),
        camera_verdicts=dict(Verdicts(state, estimate)),
        residuals={
            name: own.raw.summary(state.references[camera], state.scales[camera])
            for camera, name in cameras
            if (own := state.matches_of(camera)) is not None
        },
        counts={name: _counts(state, camera) for camera, name in cameras},
        timings_s={},
        terms="full",
        config=state.config,
        moves=tuple(map(str, state.moves)),
        motion=state.motion or "",
    )


@dataclass(frozen=True, eq=False)
class Update:
    """The estimates after a frame.

    Frames that are taken in at once share their arrays, which are read-only.

    Attributes:
        frame: its number.
        stamp_ns: its time, or None.
        T_camera_lidar: per camera, (4, 4): p_camera = T_camera_lidar * p_lidar. The guess, as long
            as the camera has no estimate.
        covariance: per camera, (6, 6) of xi in T_camera_lidar = exp(xi) estimate, xi = (rotation
            [rad], translation [m]) in the camera's axes; None until the camera has enough frames.
        verdicts: per camera, whether its estimate can be used now, with reasons; made when read.
        events: the events detected with this frame.
        used: per camera whose matches were absorbed, how many.
        left_out: cameras whose matches disagree with the estimate, and were not absorbed.
    """

    frame: int
    stamp_ns: int | None
    T_camera_lidar: dict[str, Array]
    covariance: dict[str, Array | None]
    verdicts: Mapping[str, Verdict]
    events: tuple[Event, ...]
    used: dict[str, int]
    left_out: tuple[str, ...]


def make_updates(
    state: State,
    estimate: Estimate,
    taken: Sequence[tuple[StreamFrame, Sequence[Event], Mapping[int, int]]],
) -> list[Update]:
    """The updates after the last frames of a state.

    Args:
        state: after the frames.
        estimate: of them.
        taken: the frames that were taken in at once; the events detected with each, and per camera,
            by its place in the rig, how many of its matches were absorbed.
    """
    names, verdicts = state.names, Verdicts(state, estimate)
    covariance = covariance_by_camera(estimate, names)
    estimate.T_camera_lidar.setflags(write=False)  # the updates share them
    estimate.covariance.setflags(write=False)
    last = {n: own[-1:] for n, own in zip(names, state.agreements, strict=True)}
    return [
        Update(
            frame=one.frame,
            stamp_ns=one.stamp_ns,
            T_camera_lidar=dict(zip(names, estimate.T_camera_lidar, strict=True)),
            covariance=dict(covariance),
            verdicts=verdicts,
            events=tuple(events),
            used={names[camera]: count for camera, count in used.items()},
            left_out=tuple(n for n in names if last[n] == ((one.frame, False),)),
        )
        for one, events, used in taken
    ]


def json_lines(updates: Sequence[Update]) -> list[str]:
    """A line of JSON of each update; units are in the keys, matrices row by row."""
    held, estimates, lines = None, dict[str, dict[str, Any]](), []
    for update in updates:
        if update.verdicts is not held:  # frames taken in at once have the same
            held = update.verdicts
            estimates = {name: _estimate(update, name) for name in update.T_camera_lidar}
        cameras = {
            name: {**own, "used": update.used.get(name, 0), "left_out": name in update.left_out}
            for name, own in estimates.items()
        }
        head = {"frame": update.frame, "stamp_ns": update.stamp_ns}
        content = {**head, "cameras": cameras, "events": [*map(_event, update.events)]}
        try:
            lines.append(json.dumps(content, allow_nan=False))
        except ValueError:  # of numbers that JSON does not have
            lines.append(json.dumps(finite(content), allow_nan=False))
    return lines


def _estimate(update: Update, name: str) -> dict[str, Any]:
    """What holds for all frames that were taken in at once."""
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
        "actions": list(summarize({name: verdict}).actions) if verdict.reasons else [],
    }


def _event(event: Event) -> dict[str, Any]:
    size = {} if event.size is None else vars(event.size)
    return {**vars(event), "size": size or None, "text": str(event)}
