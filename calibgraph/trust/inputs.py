"""Quick checks of a dataset and its guess, before anything is matched."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calibgraph.arrays import Array
from calibgraph.errors import DatasetError
from calibgraph.io.bags import MESSAGE_SUFFIX, scan_duration_s
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.io.frame import (
    Frame,
    ScanSteps,
    prepare_scan,
    register,
    seconds_between,
    twist_by_scans,
)
from calibgraph.matching.burnt_in import describe_burnt_in
from calibgraph.model.clock import OF_IMAGES, unused_times
from calibgraph.model.geometry import angle_deg
from calibgraph.model.plausibility import find_implausible
from calibgraph.model.rig import Rig
from calibgraph.model.verdict import Check
from calibgraph.trust.conventions import likely_intended_guess
from calibgraph.trust.corrected import corrected_clouds
from calibgraph.trust.thresholds import threshold

_log = logging.getLogger(__name__)

Level = Literal["error", "warning", "note"]
Cloud = NDArray[np.float32]


@dataclass(frozen=True)
class Finding:
    """One line about a dataset: an error stops a calibration, a warning spoils it."""

    level: Level
    text: str


def describe_repeats(what: str, digests: Iterable[tuple[str, str]]) -> str:
    """A line on frames with the same cloud or image, which are not independent; empty if none are.

    By the name of each frame, and a digest of what it has.
    """
    first: dict[str, str] = {}
    repeated = [(first[d], name) for name, d in digests if first.setdefault(d, name) != name]
    if not repeated:
        return ""
    others = f", and {len(repeated) - 1} more repeat one" if repeated[1:] else ""
    one, other = repeated[0]
    return f"frames {one} and {other} have the same {what}{others}; leave repeats out"


def describe_copies(copies: Iterable[tuple[str, str]]) -> str:
    """A line on frames that were left out as copies of others; empty without any."""
    named = [(name, first) for copy, first in copies for name in (first, copy)]
    return describe_repeats("cloud and images", named)


_DARK, _BRIGHT = 30.0, 225.0  # of 255; images by day have 80 to 140, of a lit street at night 40


def describe_brightness(name: str, means: Sequence[float]) -> str:
    """Why a camera's images show too little, by their mean gray levels, 0 to 255; else empty."""
    level = float(np.median(means)) if len(means) else _DARK
    if _DARK <= level <= _BRIGHT:
        return ""
    found, remedy = ("dark", "longer") if level < _DARK else ("bright", "shorter")
    return (
        f"the images of {name} are too {found} to show structure: their mean brightness is "
        f"{level:.0f} of 255; record by daylight, uncover the lens, or expose {remedy}"
    )


def find_doubts(rig: Rig, frame: Frame, cloud: Cloud) -> Iterator[str]:
    """Warnings about the values of a rig and about a frame's cloud, (n, >= 3) [m]."""
    yield from find_implausible(rig)
    distance = _distance_check(cloud)
    if distance.status != "PASS":
        yield distance.text
        return
    displacement = displacement_of_parts(cloud)
    if displacement is not None:
        turned, moved = displacement
        yield (
            f"the cloud of frame {frame.name} holds the same surfaces twice, {turned:.2g} deg "
            f"and {moved:.2g} m apart: clouds joined with a wrong extrinsic, or before their "
            "motion was corrected?"
        )
    is_message = frame.cloud_path.suffix == MESSAGE_SUFFIX
    if is_message and frame.find_motion and scan_duration_s(frame.cloud_path) == 0:
        yield (
            f"all points of the cloud of frame {frame.name} have the same time, so that --motion "
            "moves it as a whole: record the times of points, or leave --motion out if the driver "
            "corrects them"
        )


def _distance_check(cloud: Cloud) -> Check:
    """Whether a cloud can be in metres."""
    row = threshold("point_distance")
    median_m = float(np.median(np.linalg.norm(cloud[:, :3], axis=1)))
    centimetres = row.grade(median_m) == "WARN"  # in millimetres it would be a small room
    return row.check(median_m, advice="are the clouds in centimetres?" if centimetres else "")


def explain_guess(data: Dataset, rig: Rig, cloud: Cloud) -> str | None:
    """The convention error of the guess that the images show; not looked for in other units."""
    return likely_intended_guess(data, rig) if _distance_check(cloud).status == "PASS" else None


def count_points_in_view(rig: Rig, cloud: Cloud) -> dict[str, int]:
    """Per camera, the number of cloud points in the image at the guess."""
    counts, points = {}, cloud[:, :3].astype(np.float64)
    for name, camera in rig.cameras.items():
        pixels, valid = camera.lens.project(points, camera.T_camera_lidar)
        counts[name] = int(np.sum(valid & camera.in_image(pixels)))
    return counts


def describe_out_of_view(in_view: Mapping[str, int]) -> list[str]:
    """A line per camera without cloud points in view, by :func:`count_points_in_view`."""
    return [
        f"{name}: by the guess, no point of the cloud lies in the image"
        for name, count in in_view.items()
        if not count
    ]


def check_inputs(data: Dataset, rig: Rig, *, at_guess: bool = True) -> tuple[str, ...]:
    """Warnings about a dataset and its guess, before cameras are searched for; they are logged.

    Raises:
        FileError: if a cloud cannot be read.
        DatasetError: if no camera has points of a cloud in view. One that has none may still be
            placed by co-visible features.
    """
    doubts = _check_at_guess(data, rig) if at_guess else find_implausible(rig)
    doubts += filter(None, [*motion_doubts(data), corrected_clouds(data)])
    for text in doubts:
        _log.warning(text)
    known = data.frames[0].twist_per_s is not None
    return (*unused_times(rig, is_known=known, how=OF_IMAGES), *doubts, *describe_burnt_in(data))


def _check_at_guess(data: Dataset, rig: Rig) -> list[str]:
    frame = data.frames[len(data.frames) // 2]
    cloud = frame.load_cloud()
    doubts = [*find_doubts(rig, frame, cloud)]
    out_of_view = describe_out_of_view(count_points_in_view(rig, cloud))
    if len(out_of_view) < len(rig.cameras):
        return [*doubts, *out_of_view]
    reasons = [explain_guess(data, rig, cloud), *doubts, *out_of_view]
    raise DatasetError("; ".join(reason for reason in reasons if reason))


APART_DEG, APART_M = 0.5, 0.1
"""Least displacement that counts, if with it the parts show the same surfaces, and nearer ones. Of
115 clouds of 19 recordings 11 have parts that overlap, at most 0.78 of them after a registration;
of clouds that were joined wrongly 0.96 and more, with neighbours 1.8 times as near and more."""
_SAME, _NEARER = 0.9, 1.3
_SPLITS = (0.5, 0.75, 0.25)
"""Where a cloud may be joined of two, whose points follow one another: of equal or other sizes."""
_RANGE_M = 2.0, 50.0  # without the vehicle itself, and sparse points
_COMPARED, _LEAST_POINTS = 1_500, 100
_OVERLAP, _OVERLAP_M = 0.5, 0.5  # share of points with a neighbour so near; scans sweep on


def displacement_of_parts(points_m: NDArray[np.floating]) -> tuple[float, float] | None:
    """Displacement of two parts of a cloud that show the same surfaces: degrees and metres.

    Of (n, >= 3) points in the order of the file. None if the parts agree, or show different
    surfaces, as parts of one sweep do.
    """
    xyz = points_m[:, :3].astype(np.float64)
    distance_m = np.linalg.norm(xyz, axis=1)
    xyz = xyz[(distance_m > _RANGE_M[0]) & (distance_m < _RANGE_M[1])]
    for share in _SPLITS:
        first, second = np.split(xyz, [int(share * len(xyz))])
        if min(len(first), len(second)) < _LEAST_POINTS:
            continue
        tree, some = cKDTree(first), second[:: max(1, len(second) // _COMPARED)]
        before_m = tree.query(some)[0]
        if np.mean(before_m < _OVERLAP_M) < _OVERLAP:
            continue
        with suppress(DatasetError):  # they do not fit
            T = register(prepare_scan(first), prepare_scan(second), Path())
            after_m = tree.query(some @ T[:3, :3].T + T[:3, 3])[0]
            degrees, metres = angle_deg(T[:3, :3]), float(np.linalg.norm(T[:3, 3]))
            is_one = np.mean(after_m < _OVERLAP_M) > _SAME
            is_nearer = np.median(before_m) > _NEARER * np.median(after_m)
            if is_one and is_nearer and (degrees > APART_DEG or metres > APART_M):
                return degrees, metres
    return None


INTERVAL_S = 0.1  # between clouds, where they have no stamps
MAX_STEPS = 10  # between the numbers of neighbouring clouds, if it is clouds that they count
MAX_FRAMES = 10  # evenly spread: bounds the time
_JERK, _JERK_M_S = 0.2, 1.0  # share and size by which the speeds to both neighbours may differ
_FEWEST, _FAST_M_S, _TURN_RAD_S = 3, 2.0, 0.03  # that show a speed, and turns
_OTHER_SPEED = 1.5  # times
_KMH, _LIKE = 3.6, 0.15  # share by which a ratio may differ from that of km/h to m/s
_OTHER_AXES, _THESE_AXES = 0.5, 0.9  # correlation of turns: at most, and with others at least
_AXES = "wx", "wy", "wz"


def motion_doubts(dataset: Dataset) -> list[str]:
    """A line if neighbouring clouds show another speed than is given, or turns about other axes.

    Without stamps the time between clouds is not known; then the speed is that per turn.
    """
    given = [f for f in dataset.frames if f.find_twist is None and f.twist_per_s is not None]
    steps, pairs, timed = ScanSteps(), list[tuple[Array, Array]](), True
    for frame in spread_out(given, MAX_FRAMES):
        found = register_neighbours(dataset, frame, steps)
        if found is not None and frame.twist_per_s is not None:
            pairs.append((frame.twist_per_s, found))
            near = dataset.neighbour(frame, 1)
            timed &= near is not None and seconds_between(frame, near) is not None
    if len(pairs) < _FEWEST:
        return []
    told, shown = (np.array(each) for each in zip(*pairs, strict=True))
    return [*_axes_doubt(told[:, :3], shown[:, :3]), *_speed_doubt(told, shown, timed=timed)]


def _axes_doubt(told: Array, shown: Array) -> list[str]:
    if np.linalg.norm(shown, axis=1).mean() < _TURN_RAD_S:
        return []
    size = np.linalg.norm(told) * np.linalg.norm(shown)
    alike = {
        order: (told[:, order] * shown).sum() / max(size, 1e-12) for order in permutations(range(3))
    }
    best = max(alike, key=lambda order: alike[order])
    if alike[0, 1, 2] > _OTHER_AXES or alike[best] < _THESE_AXES:
        return []
    names = ", ".join(_AXES[axis] for axis in best)
    return [
        "by neighbouring clouds, the LiDAR turns about other axes than its motion states: "
        f"{names} in the place of {', '.join(_AXES)} would fit; check their order"
    ]


def _speed_doubt(told: Array, shown: Array, *, timed: bool) -> list[str]:
    speeds = [np.linalg.norm(each[:, 3:], axis=1) for each in (told, shown)]
    fast = speeds[1] > _FAST_M_S
    if fast.sum() < _FEWEST:
        return []
    turns = [np.linalg.norm(each[fast, :3], axis=1).sum() for each in (told, shown)]
    if not timed and turns[1] / fast.sum() < _TURN_RAD_S:
        return []
    scale = 1.0 if timed else turns[0] / turns[1]
    by_clouds = scale * float(np.median(speeds[1][fast]))
    ratio = float(np.median(speeds[0][fast])) / max(by_clouds, 1e-12)
    if 1 / _OTHER_SPEED < ratio < _OTHER_SPEED:
        return []
    unit = "; is it in km/h?" if abs(ratio / _KMH - 1) < _LIKE else "; check its unit"
    return [
        f"by neighbouring clouds, the LiDAR moves at {by_clouds:.1f} m/s, by its motion at "
        f"{ratio * by_clouds:.1f} m/s{unit}"
    ]


def registered_twists(dataset: Dataset) -> dict[int, Array]:
    """By number of a kept frame whose motion is not known, its twist (6,) by both neighbours.

    Found once: another thread that asks meanwhile waits.

    Raises:
        CalibrationError, OSError: if a cloud cannot be read.
    """
    chosen = spread_out(dataset.frames, MAX_FRAMES)
    frames = [f for f in chosen if f.kept and f.twist_per_s is None]

    def register() -> dict[int, Array]:
        steps = ScanSteps()
        found = ((frame.index, register_neighbours(dataset, frame, steps)) for frame in frames)
        return {number: twist for number, twist in found if twist is not None}

    key = "twists", *(frame.index for frame in frames)
    return frames[0].derive_for_all(key, register) if frames else {}


def register_neighbours(dataset: Dataset, frame: Frame, steps: ScanSteps) -> Array | None:
    """(6,) the twist by both neighbours, if they are as far away as of one drive."""
    near = [dataset.neighbour(frame, sign) for sign in (-1, 1)]
    known = [(other, _later_s(frame, other)) for other in near if other is not None]
    if len(known) < len(near) or not all(later_s for _, later_s in known):
        return None
    try:
        before, after = (twist_by_scans(frame, [one], steps) for one in known)
    except DatasetError:  # they do not fit
        return None
    jerk = np.linalg.norm(after[3:] - before[3:])
    if jerk > _JERK * np.linalg.norm(after[3:]) + _JERK_M_S:
        return None
    return np.asarray((before + after) / 2)


def _later_s(frame: Frame, other: Frame) -> float:
    """How much later a neighbour was recorded: by stamps, or by the numbers of both clouds."""
    by_stamps = seconds_between(frame, other)
    if by_stamps is not None:
        return by_stamps
    stems = frame.cloud_path.stem, other.cloud_path.stem
    steps = int(stems[1]) - int(stems[0]) if all(map(str.isdecimal, stems)) else 0
    if not 0 < abs(steps) <= MAX_STEPS:  # other numbers, such as times
        steps = 1 if other.index > frame.index else -1
    return INTERVAL_S * steps
