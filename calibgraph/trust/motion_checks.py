"""Whether the motion that is given is that which neighbouring clouds show: its units and axes."""

from __future__ import annotations

from itertools import permutations

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import DatasetError
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.io.frame import Frame, ScanSteps, seconds_between, twist_by_scans
from calibgraph.io.kept_frames import KeptFrame

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
    frames = [f for f in chosen if isinstance(f, KeptFrame) and f.twist_per_s is None]

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
