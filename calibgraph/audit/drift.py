"""``drift``: which of several results of one rig deviates, of which camera, in which axis?"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from scipy.linalg import block_diag

from calibgraph.arrays import Array
from calibgraph.audit.judgement import (
    CAMERA_AXES,
    LIDAR_AXES,
    SINGLE_CAMERA,
    SINGLE_LIDAR,
    Limits,
    detectable,
    find_lidar_motion,
    judge_deviation,
    tolerance_twist,
)
from calibgraph.audit.lidars import freedom_of_places
from calibgraph.audit.model import Deviations, LimitsOf, compare, poses_of
from calibgraph.audit.result import ORDER, CameraAudit, lidar_summary
from calibgraph.errors import CalibrationError
from calibgraph.io.calibrations import load_calibration
from calibgraph.model.calibration import Calibration
from calibgraph.model.geometry import invert, rows_of_poses
from calibgraph.model.result_files import CALIBRATION_FILE
from calibgraph.model.rig import IMAGE_TIMES
from calibgraph.model.verdict import COMMON_ERROR
from calibgraph.solver.covariance import PSEUDO_FRAMES

FALSE_ALARM_RATE = 0.01
"""Probability of a significant axis in one call, over all cameras and results."""

_LIDAR_AXES = tuple(f"{verb} {axis}" for verb in ("about", "along") for axis in "xyz")

_FAILED = "its verdict is FAIL, so that nothing is known of its error: do what its report advises"
_NO_ERROR_BAR = "it has no error bar: its matches do not determine the camera"
_SCATTER_ONLY = (
    "its error bar is of the scatter alone: solve it again with --common-deg, --common-cm"
)
_ALONE = "no other result has an error bar of this camera that holds; give more results"


@dataclass(frozen=True, eq=False)
class Drift:
    """A comparison of results of one rig.

    Attributes:
        results: their names.
        cameras: per camera, one entry per result.
        lidar: per result, how the LiDAR moved, where that alone explains the deviation of every
            camera; None otherwise.
        tolerance_deg, tolerance_cm: largest turn and shift that are OK.
        false_alarm_rate: probability of one CHANGED or more in this call if nothing has changed.
        same_recording: pairs of results that were made from the same files.
        lidars: LiDARs but the base, which are among ``cameras``.
    """

    results: tuple[str, ...]
    cameras: Mapping[str, tuple[CameraAudit, ...]]
    lidar: tuple[CameraAudit | None, ...]
    tolerance_deg: float
    tolerance_cm: float
    false_alarm_rate: float
    same_recording: tuple[tuple[str, str], ...] = ()
    lidars: tuple[str, ...] = ()

    @property
    def same_recording_note(self) -> str:
        """Sentences on results of one recording; empty if there are none."""
        if not self.same_recording:
            return ""
        pairs = "; ".join(" and ".join(pair) for pair in self.same_recording)
        return (
            f"Made from one recording: {pairs}. They share its errors, and that they agree shows "
            "nothing. Give one result of each recording."
        )

    @property
    def status(self) -> str:
        """The worst status of a camera in a result."""
        every = (each.status for entries in self.cameras.values() for each in entries)
        return max(every, key=ORDER.index)

    @property
    def changed(self) -> tuple[tuple[str, str], ...]:
        """Pairs of a result and what CHANGED there: "LiDAR", or a camera."""
        return tuple(
            (result, name)
            for place, (result, lidar) in enumerate(zip(self.results, self.lidar, strict=True))
            for name in (self.cameras if lidar is None else ["LiDAR"])
            if lidar is not None or self.cameras[name][place].status == "CHANGED"
        )


Result: TypeAlias = Calibration | Path | str
Results: TypeAlias = Sequence[Result] | Mapping[str, Result]


def drift(
    results: Results,
    *,
    tolerance_deg: float = 0.5,
    tolerance_cm: float = 10.0,
    own_lenses: bool = False,
) -> Drift:
    """Compare results of one rig with each other, without a reference: of days, or of vehicles.

    Each result is compared with the weighted mean of the others that agree. Errors that all
    results share, of the matcher or of the lens, cancel in a difference; results do not state how
    large this part is, so that the whole covariances count, and the test is conservative.

    Args:
        results: two or more, or their folders or files; of a mapping the keys are their names.
        tolerance_deg: largest turn of a camera that is OK.
        tolerance_cm: largest shift of a camera that is OK.
        own_lenses: whether the parameters of the lenses may differ, as between vehicles.

    Returns:
        Per camera and result OK, CHANGED or CANNOT TELL, the deviation per axis, its error bar and
        the smallest change that would be detected.

    Raises:
        CalibrationError: if a file cannot be read, or the results are not of one rig.
        ValueError: if a tolerance is not positive.
    """
    tolerance = tolerance_twist(tolerance_deg, tolerance_cm)
    opened = open_results(results, own_lenses=own_lenses)
    names, loaded, count = (*opened,), (*opened.values(),), len(opened)
    cameras = loaded[0].joint_names
    rate = FALSE_ALARM_RATE / (len(cameras) * count)
    limits = partial(Limits.of, rate=rate, tolerance=tolerance)
    found = {name: _deviations(loaded, name, limits) for name in cameras}
    judged = {name: _judge(opened, name, each, limits) for name, each in found.items()}
    compared = {name: each for name, each in found.items() if each is not None}
    hashes = {name: {*result.inputs.values()} for name, result in opened.items()}
    return Drift(
        results=names,
        cameras=judged,
        lidar=tuple(
            _lidar(loaded, place, compared, judged, limits=limits) for place in range(count)
        ),
        tolerance_deg=tolerance_deg,
        tolerance_cm=tolerance_cm,
        false_alarm_rate=FALSE_ALARM_RATE,
        same_recording=tuple((a, b) for a, b in combinations(names, 2) if hashes[a] & hashes[b]),
        lidars=tuple(loaded[0].lidar_verdicts),
    )


def _why_unusable(result: Calibration, name: str) -> str:
    """Why the pose of a camera takes no part; empty if it does."""
    if not result.error_bar_holds(name):
        return _FAILED
    covariance = _covariance(result, name)
    if covariance is None or np.linalg.eigvalsh(covariance)[0] <= 0:
        return _NO_ERROR_BAR
    if any(check.kind == COMMON_ERROR for check in result.verdicts[name].checks):
        return _SCATTER_ONLY
    return ""


def _deviations(results: Sequence[Calibration], name: str, limits: LimitsOf) -> Deviations | None:
    """The deviations of one camera; None with fewer than two usable results."""
    usable = [k for k, each in enumerate(results) if not _why_unusable(each, name)]
    if len(usable) < 2:  # noqa: PLR2004 - a comparison
        return None
    seen = [results[place] for place in usable]
    T_camera_lidar = np.array([_pose(each, name) for each in seen])
    covariance = np.array([_covariance(each, name) for each in seen])
    freedom = np.array([_freedom(each, name) for each in seen])
    return compare(poses_of(usable, T_camera_lidar, covariance, freedom), limits)


def _pose(result: Calibration, name: str) -> Array:
    """(4, 4) T_camera_lidar; of another LiDAR than the base, which counts as a camera, likewise."""
    if name in result.rig.cameras:
        return result.T_camera_lidar[name]
    return invert(result.T_base_lidar[name])


def _covariance(result: Calibration, name: str) -> Array | None:
    """(6, 6) in the sensor's own axes; None without error bar."""
    if name in result.rig.cameras:
        return result.covariance[name]
    covariance, to_own = (result.rig.lidars or {})[name].covariance, _to_own_axes(result, name)
    return None if covariance is None else to_own @ covariance @ to_own.T


def _to_own_axes(result: Calibration, name: str) -> Array:
    """(6, 6) from the axes in which a result has a covariance, for LiDARs those of the base."""
    if name in result.rig.cameras:
        return np.eye(6)
    return np.asarray(block_diag(*[result.T_base_lidar[name][:3, :3].T] * 2))


def _freedom(result: Calibration, name: str) -> float:
    """Degrees of freedom of a covariance."""
    if name in result.rig.cameras:
        frames = result.counts[name].get("frames_used", 1)
        return max(frames, 1.0) - 1.0 + PSEUDO_FRAMES
    values = {check.kind or check.name: check.value for check in result.verdicts[name].checks}
    return freedom_of_places(int(values["lidar_instants"] or 1), len(result.lidar_verdicts))


def _judge(
    results: Mapping[str, Calibration], camera: str, found: Deviations | None, limits: LimitsOf
) -> tuple[CameraAudit, ...]:
    """The status of one camera in every result."""
    names = [*results]
    judged = [CameraAudit("CANNOT TELL", _why_unusable(each, camera) or _ALONE)
              for each in results.values()]  # fmt: skip
    if found is None:
        return tuple(judged)
    of_one = results[names[0]]
    alone = SINGLE_CAMERA if of_one.rig.cameras else SINGLE_LIDAR
    axes_of = CAMERA_AXES if camera in of_one.rig.cameras else LIDAR_AXES
    alone = "" if len(of_one.joint_names) > 1 else alone
    for row, place in enumerate(found.poses.results):
        deviation, covariance = found.deviation[row], found.covariance[row]
        own, sigma = limits(found.freedom[row]), np.sqrt(np.diag(covariance))
        status, reason = judge_deviation(deviation, covariance, own, axes=axes_of)
        axes: tuple[int, ...] = ()
        if status == "WRONG":
            status = "CHANGED"
            axes = tuple(np.flatnonzero(own.exceeded(deviation, covariance)).tolist())
            reason += _whose_change(names, found, row) + alone
        smallest = detectable(sigma, own.axis)
        judged[place] = CameraAudit(status, reason, deviation, sigma, smallest, axes=axes)
    return tuple(judged)


def _whose_change(names: Sequence[str], found: Deviations, row: int) -> str:
    """The other results that may have changed instead, as the end of a sentence."""
    count, agreeing = len(found.poses), np.count_nonzero(found.agreeing)
    others = [names[k] for k in found.poses.results[found.ambiguous[row]]]
    if not others:
        return ""
    if count == 2:  # noqa: PLR2004 - no majority
        return f" from {others[0]}; of two results it is not known which changed: give a third"
    if 2 * agreeing <= count:
        return "; no more than half of the results agree, so that it is not known which changed"
    return f"; it may be {' or '.join(others)} that changed, not this result: give more results"


def _lidar(
    results: Sequence[Calibration],
    place: int,
    compared: Mapping[str, Deviations],
    judged: Mapping[str, tuple[CameraAudit, ...]],
    *,
    limits: LimitsOf,
) -> CameraAudit | None:
    """The motion of the LiDAR that explains how all cameras of one result deviate."""
    rows = {name: int(np.flatnonzero(each.poses.results == place)[0])
            for name, each in compared.items() if place in each.poses.results}  # fmt: skip
    moved = [k for k, name in enumerate(rows) if judged[name][place].status == "CHANGED"]
    if len(rows) < 2:  # noqa: PLR2004 - one camera cannot be told from the LiDAR
        return None
    covariance = _joint_covariance(results, rows, compared)
    if covariance is None:
        return None
    freedom = np.min([compared[name].freedom[row] for name, row in rows.items()])
    return find_lidar_motion(
        np.concatenate([compared[name].deviation[row] for name, row in rows.items()]),
        covariance,
        [compared[name].poses.base for name in rows],
        moved=moved,
        quantile=limits(freedom).axis[0],
    )


def _joint_covariance(
    results: Sequence[Calibration], rows: Mapping[str, int], compared: Mapping[str, Deviations]
) -> Array | None:
    """(6 N, 6 N) of one result's deviations of these cameras; None if it is not known."""
    gains = {name: compared[name].coefficients(row) for name, row in rows.items()}
    whole = np.zeros((6 * len(rows), 6 * len(rows)))
    for other, result in enumerate(results):
        at = {name: np.flatnonzero(compared[name].poses.results == other) for name in rows}
        parts = [gains[name][k[0]] if len(k) else np.zeros((6, 6)) for name, k in at.items()]
        if not np.any(parts):
            continue
        if result.joint_covariance is None:
            return None
        columns = rows_of_poses([*rows], result.joint_names)
        gain = block_diag(*parts) @ block_diag(*[_to_own_axes(result, name) for name in rows])
        whole += gain @ result.joint_covariance[np.ix_(columns, columns)] @ gain.T
    return whole if np.linalg.eigvalsh(whole)[0] > 0 else None


def open_results(given: Results, *, own_lenses: bool) -> dict[str, Calibration]:
    """The results by their names: those given, of files the paths below their common folder.

    Raises:
        FileError: if one cannot be read.
        CalibrationError: if there are fewer than two, or they are not of one rig.
    """
    names = [*given] if isinstance(given, Mapping) else _names(given)
    items = [*given.values()] if isinstance(given, Mapping) else [*given]
    loaded = [item if isinstance(item, Calibration) else load_calibration(item) for item in items]
    if len(loaded) < 2:  # noqa: PLR2004 - a comparison
        raise CalibrationError(f"{len(loaded)} result given; a comparison needs two or more")
    seen: dict[bytes, str] = {}
    for name, result in zip(names, loaded, strict=True):
        poses = {**result.T_base_lidar, **result.T_camera_lidar}
        extrinsics = b"".join(T.tobytes() for _, T in sorted(poses.items()))
        if extrinsics in seen:  # equal to the last bit: a copy
            raise CalibrationError(
                f"{name}: is the same result as {seen[extrinsics]}; give each once"
            )
        seen[extrinsics] = name
        _require_same_rig(names[0], loaded[0], name, result, own_lenses=own_lenses)
    return dict(zip(names, loaded, strict=True))


def _names(given: Sequence[Result]) -> list[str]:
    """Paths below the common folder; of results in memory their places, from 1."""
    paths = [Path(item).resolve() for item in given if not isinstance(item, Calibration)]
    if len(paths) < len(given) or not paths:
        return [f"result {place}" for place in range(1, len(given) + 1)]
    ends = [path.parent if path.name == CALIBRATION_FILE else path for path in paths]
    if len(set(ends)) < len(ends):
        return [str(item) for item in given]
    common = os.path.commonpath([end.parent for end in ends])
    return [str(end.relative_to(common)) for end in ends]


def _require_same_rig(
    first: str, one: Calibration, name: str, two: Calibration, *, own_lenses: bool
) -> None:
    """Check that two results have the same cameras and LiDARs."""
    a, b = one.rig.cameras, two.rig.cameras
    if one.rig.all_lidars != two.rig.all_lidars:
        raise CalibrationError(
            f"{name}: has the LiDARs {', '.join(two.rig.all_lidars) or two.rig.lidar}, {first} has "
            f"{', '.join(one.rig.all_lidars) or one.rig.lidar}, the base first; give results of "
            "one rig"
        )
    parts = {"T_camera_lidar", *IMAGE_TIMES}
    parts |= {"intrinsics_px", "distortion"} if own_lenses else set()
    if a.keys() != b.keys():
        raise CalibrationError(
            f"{name}: has the cameras {', '.join(b)}, {first} has {', '.join(a)}; give results of "
            "one rig"
        )
    if two.config.of != one.config.of:
        raise CalibrationError(
            f"{name}: has poses of the {two.config.of}, {first} of the {one.config.of}, which are "
            "different quantities; solve one of them again with the other's --of"
        )
    for camera, other in b.items():
        if other.model_dump(exclude=parts) != a[camera].model_dump(exclude=parts):
            raise CalibrationError(
                f"{name}: camera {camera} has another image size or lens than in {first}, which "
                "would look like a motion; calibrate both with one lens, or give --own-lenses if "
                "they are several vehicles, each with lenses calibrated by themselves"
            )


def drift_summary(drift: Drift) -> dict[str, Any]:
    """A comparison as plain values; every key names its unit, every list is x, y, z."""
    cameras = {}
    for name, entries in drift.cameras.items():
        axes = _LIDAR_AXES if name in drift.lidars else CAMERA_AXES
        cameras[name] = {
            "results": {
                result: each.summary(axes=[axes[axis] for axis in each.axes])
                for result, each in zip(drift.results, entries, strict=True)
            },
        }
    lidars = zip(drift.results, drift.lidar, strict=True)
    return {
        "status": drift.status,
        "changed": [{"result": result, "what": what} for result, what in drift.changed],
        "tolerance_deg": drift.tolerance_deg,
        "tolerance_cm": drift.tolerance_cm,
        "false_alarm_rate": drift.false_alarm_rate,
        "results": list(drift.results),
        "same_recording": [list(pair) for pair in drift.same_recording],
        "cameras": cameras,
        "lidar": {result: lidar_summary(lidar) for result, lidar in lidars if lidar is not None},
    }
