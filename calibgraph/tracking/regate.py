"""A new gate for the frames whose matches are kept, at the end of an epoch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice, pairwise

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.geometry import to_T_camera_lidar
from calibgraph.solver.covariance import convex_hessian, robust_hessian
from calibgraph.solver.matches import MIN_MATCHES, BlockResiduals, CameraBlock, merge
from calibgraph.solver.within_place import WEAK
from calibgraph.tracking.frozen import changed
from calibgraph.tracking.live_frames import LiveFrame
from calibgraph.tracking.state import State
from calibgraph.tracking.sums import Sums, step_between

_GATE_STEPS = 3  # of Gauss-Newton: each leaves about a third of the way


def regate(state: State) -> State:
    """The state with its live frames gated, and linearized, at the newest estimates."""
    live = state.live_frames
    if not live:
        return state
    inliers, sums = [dict(frame.inliers) for frame in live], Sums.stack([f.sums for f in live])
    for camera in range(len(state.cameras)):
        for own, pose in _linearized_together(state, camera):
            frames, before = [live[row] for row in own], sums.hessian[own, camera]
            found, shown = _regate_camera(state, camera, frames, pose, hessian=before)
            sums.packed[own, camera] = shown.packed
            for row, rows in zip(own, found, strict=True):
                inliers[row][camera] = rows
    gated = iter(
        LiveFrame(f.number, f.raw, inliers[row], sums[row], f.place) for row, f in enumerate(live)
    )
    epochs = tuple(
        changed(epoch, frames=tuple(islice(gated, len(epoch.frames)))) for epoch in state.epochs
    )
    return changed(state, epochs=epochs)


def _linearized_together(state: State, camera: int) -> Iterator[tuple[list[int], gtsam.Pose3]]:
    """The live frames of a camera, by their places among all, that have one estimate."""
    end, rows = 0, list[int]()
    for epoch in state.epochs:
        first, end = end, end + len(epoch.frames)
        rows += [first + i for i, frame in enumerate(epoch.frames) if camera in frame.raw]
        if rows and state.cameras[camera].summary.walk:
            yield rows, epoch.T_lidar_camera[camera]
            rows = []
    if rows:
        yield rows, state.T_lidar_camera[camera]


def _regate_camera(
    state: State,
    camera: int,
    frames: Sequence[LiveFrame],
    T_lidar_camera: gtsam.Pose3,
    *,
    hessian: Array,
) -> tuple[list[NDArray[np.bool_]], Sums]:
    """A camera's inliers of (f) frames, and (f,) their sums at an estimate.

    Hessians of frames are as they were, (f, 6, 6), but for a share of what their sum is now.
    """
    scale, raw = state.cameras[camera].scale, merge([frame.raw[camera] for frame in frames])
    gate = _gate_pose(state, camera, raw, T_lidar_camera)
    rows = raw.within_gate(to_T_camera_lidar(gate), scale.gate_px)
    edges = raw.frame_edges
    counts = np.add.reduceat(rows, edges[:-1], dtype=np.int64)
    found = [rows[first:end] for first, end in pairwise(edges.tolist())]
    for frame in np.flatnonzero(counts < MIN_MATCHES).tolist():
        found[frame] = frames[frame].inliers[camera]
    inliers = raw.select(np.concatenate(found))
    block = inliers.with_scale(scale)
    here = block.frame_sums(T_lidar_camera, inliers.frame_edges, curvature=True)
    robust = robust_hessian(here)
    residuals = BlockResiduals.at(to_T_camera_lidar(gate), raw)
    true = convex_hessian(robust + residuals.gate_hessians(scale)[0], robust)
    missing = true - hessian.sum(axis=0)
    shares = here.hessian @ np.linalg.solve(here.hessian.sum(axis=0) + WEAK, missing)
    hessian = hessian + (shares + shares.swapaxes(1, 2)) / 2
    step, score = step_between(T_lidar_camera, state.references[camera]), here.gradient
    return found, Sums.of(
        hessian=hessian,
        gradient=score + hessian @ step,
        reweighted=here.hessian,
        score=score,
        scatter=score[:, :, None] * score[:, None, :],
        frames=np.ones(len(frames)),
        matches=inliers.frame_counts.astype(np.float64),
    )


def _gate_pose(
    state: State, camera: int, raw: CameraBlock, T_lidar_camera: gtsam.Pose3
) -> gtsam.Pose3:
    """Where the gate is drawn: the minimum of all matches, as in a batch.

    That of the matches within a gate is drawn to where the gate was before. A camera that drifts
    keeps its estimate, which later epochs have a part in.
    """
    one, reference = state.cameras[camera], state.references[camera]
    if one.summary.walk:
        return T_lidar_camera
    block, older = raw.with_scale(one.scale), one.summary.ungated
    for _ in range(_GATE_STEPS):
        sums, step = block.sums(T_lidar_camera), step_between(reference, T_lidar_camera)
        pull = sums.gradient + older.gradient + older.hessian @ step
        whole = sums.hessian + older.hessian + WEAK
        T_lidar_camera = T_lidar_camera.retract(-np.linalg.solve(whole, pull))
    return T_lidar_camera
