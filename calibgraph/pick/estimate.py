"""The pairs of a session, kept in a file after every change, and what they determine.

By PnP (SQPnP), then by one solve of all cameras.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
from pydantic import Field

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError, FileError
from calibgraph.files import StrictNumbers, checked_model, read_json, write_text
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.geometry import move_points, transform
from calibgraph.model.rig import Camera, Rig
from calibgraph.pipeline import solve
from calibgraph.solver.pnp import view_plane

MIN_PAIRS = 6
"""Of a camera, on different structures (paper, "Reference by manual picking")."""
SOLVE = Config(
    loss_scale_px=1e4, gate_px=1000.0, learnt_weights=False, grid_columns=400,
    grid_rows=400, common_deg=0.0, common_cm=0.0,
)  # fmt: skip
"""In effect least squares over all pairs: with a dozen a robust loss would hide a wrong one. The
picker removes it; :attr:`CameraEstimate.left_out_px` shows which it is."""
_LINE_M = 0.05  # scatter of the points off a line, below which a camera turns about it
_WRONG, _WRONG_PX = 5.0, 5.0  # of a left-out pair: times the median, and pixels


@dataclass(frozen=True, eq=False)
class CameraEstimate:
    """What the pairs of one camera give.

    Attributes:
        residuals_px: (n, 2) projected minus picked, at the estimate, or at the guess without one.
        left_out_px: (n,) distance of each pair from the pose of all others; NaN if not known.
        problem: why there is no estimate, in words.
    """

    residuals_px: Array
    left_out_px: Array
    problem: str

    @property
    def wrong(self) -> list[bool]:
        """Which pairs contradict the others."""
        limit = max(_WRONG_PX, _WRONG * float(np.median(self.left_out_px)))
        return [bool(value > limit) for value in self.left_out_px]  # NaN is not above


Estimate = tuple[Rig | None, dict[str, CameraEstimate]]
"""The rig of the cameras that are solved, with their covariances, None if none is; and by name what
the pairs of each camera give."""


def estimate_from_pairs(rig: Rig, pairs: Sequence[Pair]) -> Estimate:
    """Estimate all cameras with enough pairs, jointly.

    Args:
        rig: lenses, the guess, and measured relative poses.
        pairs: all of them.
    """
    if not pairs:
        return None, {}
    table = to_table(pairs)
    of = {name: table.of_camera(name) for name in rig.cameras if name in table.cameras}
    problems = {name: _problem(rows.points_lidar_m) for name, rows in of.items()}
    found = {name: None if problems[name] else _pnp(rig.cameras[name], of[name]) for name in of}
    starts = {name: T for name, T in found.items() if T is not None}
    solved = _solve(rig, starts, table) if starts else None
    cameras = {}
    for name, rows in of.items():
        camera, left_out = rig.cameras[name], np.full(len(rows), np.nan)
        if solved is not None and name in starts:
            camera, left_out = solved.cameras[name], _left_out(camera, rows)
        elif not problems[name]:
            problems[name] = "PnP finds no pose"
        residuals = _residuals(camera, camera.T_camera_lidar, rows)
        cameras[name] = CameraEstimate(residuals, left_out, problems[name])
    return solved, cameras


def _solve(rig: Rig, starts: dict[str, Array], table: Correspondences) -> Rig:
    """The rig of these cameras, each with its covariance."""
    ties = tuple(tie for tie in rig.relative_poses if {tie.a, tie.b} <= starts.keys())
    part = rig.model_copy(
        update={"cameras": {n: rig.cameras[n] for n in starts}, "relative_poses": ties}
    )
    table = table.without_cameras({*table.cameras} - starts.keys())
    found = solve(part.moved_to(starts), table, SOLVE, terms="reprojection")
    cameras = {}
    for name, camera in found.rig.cameras.items():
        covariance, freedom = found.covariance[name], 2 * len(table.of_camera(name)) - 6
        if covariance is not None:  # the scatter of few pairs is uncertain itself: Student's law
            covariance = covariance * freedom / (freedom - 2)
        cameras[name] = camera.model_copy(update={"covariance": covariance})
    return found.rig.model_copy(update={"cameras": cameras})


def reference_rig(estimate: Estimate) -> Rig:
    """The rig of the cameras that the pairs determine.

    Raises:
        CalibrationError: if there is none.
    """
    rig, cameras = estimate
    if rig is None:
        reasons = [f"{name}: {one.problem}" for name, one in cameras.items()]
        raise CalibrationError(
            f"the pairs determine no camera yet ({'; '.join(reasons) or 'there is none'}); pick at "
            f"least {MIN_PAIRS} of one camera, on different structures"
        )
    return rig


def _pnp(camera: Camera, pairs: Correspondences) -> Array | None:
    """T_camera_lidar; None if there is none."""
    turn, plane = view_plane(camera, pairs.pixels_px)
    usable = np.isfinite(plane[:, 0])
    if np.count_nonzero(usable) < MIN_PAIRS - 1:
        return None
    try:
        found, turned, shift = cv2.solvePnP(
            pairs.points_lidar_m[usable], plane[usable], np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP
        )
    except cv2.error:  # a degenerate layout
        return None
    T = transform(turn.T @ cv2.Rodrigues(turned)[0], turn.T @ shift.ravel())
    return T if found and np.isfinite(T).all() else None


def _left_out(camera: Camera, pairs: Correspondences) -> Array:
    """(n,) distance [px] of each pair from the pose that all others give; NaN of too few."""
    distances = np.full(len(pairs), np.nan)
    for one in np.eye(len(pairs), dtype=bool) if len(pairs) > MIN_PAIRS else ():
        T = _pnp(camera, pairs.select(~one))
        if T is not None:
            distances[one] = np.linalg.norm(_residuals(camera, T, pairs.select(one)))
    return distances


def _residuals(camera: Camera, T: Array, pairs: Correspondences) -> Array:
    """(n, 2) projected minus picked; infinite of points that the lens does not see."""
    projected, valid = camera.lens.project(move_points(pairs.points_lidar_m, T))
    return np.where(valid[:, None], projected - pairs.pixels_px, np.inf)


def _problem(points_m: Array) -> str:
    """Why pairs determine no pose; empty if they may."""
    centred = points_m - points_m.mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(points_m))
    if len(points_m) < MIN_PAIRS:
        return f"{len(points_m)} of {MIN_PAIRS} pairs"
    return "its points lie on one line" if np.hypot(*spread[1:]) < _LINE_M else ""


SESSION_FILE = "session.json"
_Number = Annotated[float, Field(ge=-1e6, le=1e6)]


class Pair(StrictNumbers):
    """A pixel and a point of the cloud that are one place.

    Attributes:
        frame: number of the frame.
        camera: its name.
        pixel_px: (column, row).
        point_lidar_m: in the LiDAR frame.
    """

    frame: Annotated[int, Field(ge=0)]
    camera: str
    pixel_px: tuple[_Number, _Number]
    point_lidar_m: tuple[_Number, _Number, _Number]


class Session(StrictNumbers):
    """The pairs, with the frames and cameras of their dataset.

    Attributes:
        frames: names, by which a session is known to fit a dataset.
        cameras: the rig's.
        pairs: in the order in which they were picked.
    """

    format: Literal["calibgraph-pick/2"] = "calibgraph-pick/2"
    frames: tuple[str, ...]
    cameras: tuple[str, ...]
    pairs: Annotated[tuple[Pair, ...], Field(max_length=2000)] = ()

    def save(self, path: Path) -> None:
        """Write the session; the file is whole or as before."""
        write_text(path, json.dumps(self.model_dump(), separators=(",", ":")) + "\n")


def open_session(path: Path, frames: Sequence[str], cameras: Sequence[str]) -> Session:
    """The session of a file, or a new one.

    Raises:
        FileError: if the file is of another dataset or no session.
    """
    new = Session(frames=tuple(frames), cameras=tuple(cameras))
    if not path.exists():
        return new
    session = checked_model(Session, read_json(path), path)
    if (session.frames, session.cameras) != (new.frames, new.cameras):
        raise FileError(
            path,
            "is a session of other frames or cameras; give the same --frames, or another --out",
        )
    return session


def to_table(pairs: Sequence[Pair]) -> Correspondences:
    """The pairs as a table of correspondences; their frames share no error of a matcher."""
    return Correspondences.from_arrays(
        camera=np.array([pair.camera for pair in pairs], dtype=np.str_),
        frame=np.array([pair.frame for pair in pairs], dtype=np.int64),
        pixels_px=np.array([pair.pixel_px for pair in pairs]),
        points_lidar_m=np.array([pair.point_lidar_m for pair in pairs]),
        metadata={
            "matcher": "pick", "systematic_rotation_rad": 0.0, "systematic_translation_m": 0.0
        },
    )  # fmt: skip
